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

// The bucket of a cell that is one of k, or none: those below 0 come first, those from k on last.
VN_HD constexpr int64_t bucket_of_cell(int32_t cell, int64_t k) {
  return cell < 0 ? 0 : cell >= k ? k + 1 : static_cast<int64_t>(cell) + 1;
}

}  // namespace voronerf
