// Index maps of the CUDA kernels that do not depend on data, and the bisection of those that do, as plain functions:
// tests/cuda_emulation/test_index_maps.py goes through all of their arguments and compares with brute force, that every
// element is met once and none out of range. Lanes are unsigned: a signed number cannot be divided by a shift alone.
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

// Where the last of some values is that do not fall and are not above another one: 32 probes at a time, of which as
// many were not above it as there are votes. The first value is taken for one that is not.
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

// The bucket of a cell that is one of k, or none: those below 0 come first, those from k on last.
VN_HD constexpr int64_t bucket_of_cell(int32_t cell, int64_t k) {
  return cell < 0 ? 0 : cell >= k ? k + 1 : static_cast<int64_t>(cell) + 1;
}

}  // namespace voronerf
