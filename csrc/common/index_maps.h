// Index maps of the CUDA kernels that do not depend on data, and the bisection of those that do, as plain functions:
// tests/cuda_emulation/test_index_maps.py goes through all of their arguments and compares with brute force, that every
// element is met once and none out of range. Threads are unsigned: a signed number cannot be divided by a shift alone.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

struct MapPlace {
  int row, column;
};

// Sum i of a lane, 0..3, in a tile [16][8] of mma.sync.
VN_HD constexpr MapPlace accumulator_place(unsigned lane, int i) {
  return {static_cast<int>(lane / 4) + 8 * (i / 2), static_cast<int>(2 * (lane % 4)) + i % 2};
}

// Where the sums of a thread's warp begin in a block's tile [64][128]: two warps by rows, two by columns, 32 x 64 each.
VN_HD constexpr MapPlace product_warp_place(unsigned thread) {
  return {static_cast<int>(thread / 32 % 2 * 32), static_cast<int>(thread / 64 * 64)};
}

// Tiles [16][8] of columns that a thread's warp has in a block with this many columns left, a multiple of 8.
VN_HD constexpr int product_warp_tiles(unsigned thread, int64_t columns) {
  const int64_t mine = columns - product_warp_place(thread).column;
  return mine <= 0 ? 0 : mine >= 64 ? 8 : static_cast<int>(mine / 8);
}

// Sum i of tile [r][t] of a thread, in the block's tile.
VN_HD constexpr MapPlace product_place(unsigned thread, int r, int t, int i) {
  const MapPlace warp = product_warp_place(thread), own = accumulator_place(thread % 32, i);
  return {warp.row + 16 * r + own.row, warp.column + 8 * t + own.column};
}

// The word of 16 bytes that a thread of `threads` copies in its turn i, in a tile [rows][words].
VN_HD constexpr MapPlace fetched_word(unsigned thread, unsigned i, unsigned threads, unsigned words) {
  const unsigned number = i * threads + thread;
  return {static_cast<int>(number / words), static_cast<int>(number % words)};
}

// The part of a cell's weight gradient [outputs][inputs] that a block computes, in tiles of down x across.
struct GradientTile {
  int64_t cell, output, input;
};
VN_HD constexpr int64_t gradient_tiles(int64_t outputs, int64_t inputs, int64_t down, int64_t across) {
  return ((outputs + down - 1) / down) * ((inputs + across - 1) / across);
}
VN_HD constexpr GradientTile gradient_tile(int64_t block, int64_t outputs, int64_t inputs, int64_t down,
                                           int64_t across) {
  const int64_t wide = (inputs + across - 1) / across, tiles = gradient_tiles(outputs, inputs, down, across);
  const int64_t cell = block / tiles, tile = block - cell * tiles;
  return {cell, tile / wide * down, tile % wide * across};
}

// Part number `part` of `parts` of the rows begin:end, all but the last non-empty one multiples of `step`; empty ones
// have their begin not before their end.
struct RowRange {
  int64_t begin, end;
};
VN_HD constexpr RowRange part_of_rows(int64_t begin, int64_t end, int64_t part, int64_t parts, int64_t step) {
  const int64_t each = (end - begin + parts - 1) / parts, share = (each + step - 1) / step * step;
  const int64_t first = begin + part * share;
  return {first, first + share < end ? first + share : end};
}

// The last of `count` values, which do not fall, that is not above `value`; 0 where all are.
VN_HD constexpr int64_t last_not_above(const int32_t* values, int64_t count, int64_t value) {
  int64_t low = 0, high = count;
  while (high - low > 1) {
    const int64_t middle = (low + high) / 2;
    if (values[middle] <= value) {
      low = middle;
    } else {
      high = middle;
    }
  }
  return low;
}

// The first of n values, which do not fall, that is above `value`; n where none is.
template <typename T>
VN_HD constexpr int64_t first_above(const T* values, int64_t n, int64_t value) {
  int64_t low = 0, high = n;
  while (low < high) {
    const int64_t middle = low + (high - low) / 2;
    if (static_cast<int64_t>(values[middle]) <= value) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

// Columns of a layer's sources one after another, as the caller has them and packed, each source padded: the column of
// a packed one, -1 for padding, and the packed one of a column.
VN_HD constexpr int64_t column_of_packed(const int64_t* widths, const int64_t* padded, int count, int64_t packed) {
  int64_t column = 0;
  for (int s = 0; s < count; ++s) {
    if (packed < padded[s]) return packed < widths[s] ? column + packed : -1;
    packed -= padded[s];
    column += widths[s];
  }
  return -1;
}
VN_HD constexpr int64_t packed_of_column(const int64_t* widths, const int64_t* padded, int count, int64_t column) {
  int64_t before = 0, packed = 0;
  for (int s = 0; s < count && column >= before + widths[s]; ++s) {
    before += widths[s];
    packed += padded[s];
  }
  return packed + column - before;
}

// The bucket of a cell that is one of k, or none: those below 0 come first, those from k on last.
VN_HD constexpr int64_t bucket_of_cell(int32_t cell, int64_t k) {
  return cell < 0 ? 0 : cell >= k ? k + 1 : static_cast<int64_t>(cell) + 1;
}

}  // namespace voronerf
