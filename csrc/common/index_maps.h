// Index maps and searches of the CUDA kernels, as plain functions. tests/cuda_emulation/test_index_maps.py goes through
// all of their arguments and compares with brute force: every element is visited once and none is out of range. Lanes
// are unsigned, because a signed number cannot be divided by a shift alone.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

struct MapPlace {
  int row, column;
};

// Returns the row and column of a lane's accumulator i (0..3) in a tile [16][8] of mma.sync.
VN_HD constexpr MapPlace accumulator_place(unsigned lane, int i) {
  return {static_cast<int>(lane / 4) + 8 * (i / 2), static_cast<int>(2 * (lane % 4)) + i % 2};
}

// The range in which a warp searches non-decreasing values for the last value that is at most a bound. `probed` returns
// the index that a lane probes, `narrowed` the range that remains if `votes` probes are at most the bound. The first
// value must be at most the bound.
struct MapSpan {
  int64_t first, last;
};
VN_HD constexpr int64_t probed(const MapSpan& span, int64_t lane) {
  return span.first + lane * ((span.last - span.first + 31) / 32);
}
VN_HD constexpr MapSpan narrowed(const MapSpan& span, int votes) {
  const int64_t first = probed(span, votes == 0 ? 0 : votes - 1), last = probed(span, votes == 0 ? 1 : votes);
  return {first, last < span.last ? last : span.last};
}

// Returns the index of the first of n non-decreasing values that is above `value`; n if none is.
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

// Returns the bucket of a cell: 0 for cells below 0, cell + 1 for the k valid cells, k + 1 for cells from k on.
VN_HD constexpr int64_t bucket_of_cell(int32_t cell, int64_t k) {
  return cell < 0 ? 0 : cell >= k ? k + 1 : static_cast<int64_t>(cell) + 1;
}

}  // namespace voronerf
