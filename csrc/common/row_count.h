// A number of rows, such as the samples or rays of a step. A recorded call reads it again from memory at every replay
// (bindings/bind.cpp).
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

#ifdef __CUDACC__
#define VN_COUNT_HD __host__ __device__
#else
#define VN_COUNT_HD
#endif

struct RowCount {
  int64_t value = 0;
  RowCount() = default;
  VN_COUNT_HD constexpr RowCount(int64_t count) : value(count) {}
  VN_COUNT_HD constexpr operator int64_t() const { return value; }
};

}  // namespace voronerf
