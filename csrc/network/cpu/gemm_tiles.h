// The products of gemm_tile.h in tile registers (tile_registers.h), 16 rows by 16 columns by 16 pairs at a time: all
// operands are pairs, and depths are filled up with 0 to 16 of them.
//
// A block of 32 rows by 32 columns has four registers of sums, two of A and two of B: as many loads as products, which
// take twice as long. The sums of a block go to memory, in the first-level cache, and are finished (a ReLU, rounding)
// while the products of the next one run: what waits for them would fill the processor's queue before those products
// come into it.
#pragma once

#include "network/cpu/gemm_tile.h"
#include "network/cpu/tile_registers.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
inline namespace tiles_of_pairs {
namespace {

constexpr int64_t kBlock = 2 * kTileRows, kStep = 16;  // rows and columns of a block, pairs of a register

// For blocks of up to so many rows: registers 0 to 3 are sums, 4 and 5 A, 6 and 7 B.
VN_INLINE void shape_for(int64_t rows) {
  TileShapes shapes;
  for (int i = 0; i < 8; ++i) {
    const int64_t own = i > 5 ? kTileRows : rows - (i < 4 ? i / 2 : i % 2) * kTileRows;
    shapes.bytes[i] = kTileBytes;
    shapes.rows[i] = static_cast<uint8_t>(own > kTileRows ? kTileRows : own < 1 ? 1 : own);
  }
  shape_tiles(shapes);
}

template <int R, int C>
VN_INLINE void block_products(const Product& p, int64_t row, int64_t column, float* to, int64_t to_stride) {
  constexpr int64_t kFloat = sizeof(float);
  if (p.start == kZeros) {
    tile_zero<0>();
    if (C > 1) tile_zero<1>();
    if (R > 1) tile_zero<2>();
    if (R > 1 && C > 1) tile_zero<3>();
  } else {
    const float* const start = p.start + row * p.start_stride + column;
    const int64_t stride = p.start_stride * kFloat;
    tile_load<0>(start, stride);
    if (C > 1) tile_load<1>(start + kTileRows, stride);
    if (R > 1) tile_load<2>(start + kTileRows * p.start_stride, stride);
    if (R > 1 && C > 1) tile_load<3>(start + kTileRows * p.start_stride + kTileRows, stride);
  }
  const Source& source = *p.sources;
  const float *a = source.data + row * source.stride, *b = p.b + column;
  const int64_t a_stride = source.stride * kFloat, b_stride = p.b_stride * kFloat;
  for (int64_t k = 0; k < source.depth; k += kStep, a += kStep, b += kStep * p.b_stride) {
    tile_load<6>(b, b_stride);
    tile_load<4>(a, a_stride);
    tile_products<0, 4, 6>();
    if (R > 1) {
      tile_load<5>(a + kTileRows * source.stride, a_stride);
      tile_products<2, 5, 6>();
    }
    if (C > 1) {
      tile_load<7>(b + kTileRows, b_stride);
      tile_products<1, 4, 7>();
      if (R > 1) tile_products<3, 5, 7>();
    }
  }
  tile_store<0>(to, to_stride * kFloat);
  if (C > 1) tile_store<1>(to + kTileRows, to_stride * kFloat);
  if (R > 1) tile_store<2>(to + kTileRows * to_stride, to_stride * kFloat);
  if (R > 1 && C > 1) tile_store<3>(to + kTileRows * to_stride + kTileRows, to_stride * kFloat);
}

// A block whose sums are in memory, [rows][kBlock].
struct Sums {
  const float* data;
  int64_t row, column, rows, columns;
};

// Columns [column, column + kLanes) of a row of sums, behind the last of which there are zeros.
VN_INLINE F32 sum_of(const Sums& sums, int64_t row, int64_t column) {
  return column < sums.columns ? load(sums.data + row * kBlock + column) : splat(0.0f);
}

// Where a slope is 0 or less, the result is 0.
VN_INLINE F32 by_slope(F32 slope, F32 sum) { return slope <= splat(0.0f) ? splat(0.0f) : sum; }

// `finished(row, column, low, high)` of two neighbouring vectors of sums makes them what they are to be.
template <typename Finished>
VN_INLINE void store_sums(const Product& p, const Sums& sums, const Finished& finished) {
  float* const c = p.c == nullptr ? nullptr : p.c + sums.row * p.c_stride + sums.column;
  float* const pairs = p.pairs == nullptr ? nullptr : p.pairs + sums.row * p.pairs_stride + sums.column / 2;
  for (int64_t row = 0; row < sums.rows; ++row) {
    for (int64_t column = 0; column < kBlock; column += 2 * kLanes) {
      F32 low = sum_of(sums, row, column), high = sum_of(sums, row, column + kLanes);
      finished(row, column, low, high);
      if (pairs != nullptr) store(pairs + row * p.pairs_stride + column / 2, joined(low, high));
      if (c == nullptr) continue;
      if (column < sums.columns) store(c + row * p.c_stride + column, low);
      if (column + kLanes < sums.columns) store(c + row * p.c_stride + column + kLanes, high);
    }
  }
}

VN_INLINE void finish(const Product& p, const Sums& sums) {
  const F32 zero = splat(0.0f);
  if (p.finish == Finish::none) {
    store_sums(p, sums, [](int64_t, int64_t, F32&, F32&) {});
  } else if (p.finish == Finish::relu) {  // NaN passes
    store_sums(p, sums, [=](int64_t, int64_t, F32& low, F32& high) {
      low = max(zero, low);
      high = max(zero, high);
    });
  } else if (p.slope_in_pairs) {
    const float* const slope = p.slope + sums.row * p.pairs_stride + sums.column / 2;
    store_sums(p, sums, [&](int64_t row, int64_t column, F32& low, F32& high) {
      const F32 both = load(slope + row * p.pairs_stride + column / 2);
      low = by_slope(widened(both, 0), low);
      high = by_slope(widened(both, 1), high);
    });
  } else {
    const float* const slope = p.slope + sums.row * p.c_stride + sums.column;
    store_sums(p, sums, [&](int64_t row, int64_t column, F32& low, F32& high) {
      const float* const from = slope + row * p.c_stride + column;
      if (column < sums.columns) low = by_slope(load(from), low);
      if (column + kLanes < sums.columns) high = by_slope(load(from + kLanes), high);
    });
  }
}

}  // namespace

// C [rows][columns], columns a multiple of 16; the shapes of the registers are those of whole blocks, before and after.
VN_INLINE void multiply_tiles(const Product& p, int64_t rows, int64_t columns) {
  alignas(64) float memory[2][kBlock * kBlock];
  const bool direct = p.finish == Finish::none && p.pairs == nullptr;
  Sums before{};
  int turn = 0;
  for (int64_t row = 0; row < rows; row += kBlock) {
    const int64_t some = rows - row < kBlock ? rows - row : kBlock;
    if (some < kBlock) shape_for(some);
    for (int64_t column = 0; column < columns; column += kBlock, turn ^= 1) {
      const int64_t wide = columns - column < kBlock ? columns - column : kBlock;
      float* const to = direct ? p.c + row * p.c_stride + column : memory[turn];
      const int64_t to_stride = direct ? p.c_stride : kBlock;
      if (some > kTileRows) {
        if (wide > kTileRows) {
          block_products<2, 2>(p, row, column, to, to_stride);
        } else {
          block_products<2, 1>(p, row, column, to, to_stride);
        }
      } else if (wide > kTileRows) {
        block_products<1, 2>(p, row, column, to, to_stride);
      } else {
        block_products<1, 1>(p, row, column, to, to_stride);
      }
      if (direct) continue;
      if (before.rows > 0) finish(p, before);
      before = {memory[turn], row, column, some, wide};
    }
    if (some < kBlock) shape_for(kBlock);
  }
  if (before.rows > 0) finish(p, before);
}

}  // namespace tiles_of_pairs
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
