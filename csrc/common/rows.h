// A number of rows, such as samples or rays of a step: what a recorded call reads again from memory each time that it
// is replayed (bindings/recording.h).
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

#ifdef __CUDACC__
#define VN_ROWS_HD __host__ __device__
#else
#define VN_ROWS_HD
#endif

struct Rows {
  int64_t value = 0;
  Rows() = default;
  VN_ROWS_HD constexpr Rows(int64_t count) : value(count) {}
  VN_ROWS_HD constexpr operator int64_t() const { return value; }
};

}  // namespace voronerf
