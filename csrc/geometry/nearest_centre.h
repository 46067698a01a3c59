// Nearest centre: points [n,3], centres [k,3] -> cells [n]. Exact, ties to the lowest index, non-finite points to cell
// 0 (nearest_centre_math.h). k >= 1; n = 0 is legal.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

template <typename T>
void nearest_centre_cpu(const T* points, const T* centres, int32_t* cells, RowCount n, int64_t k, Isa isa, int threads);
// rows: [1], how many points count, the others get -1; null for all.
template <typename T>
void nearest_centre_cuda(const T* points, const T* centres, const int32_t* rows, int32_t* cells, int64_t n, int64_t k,
                         void* stream);

// The same on the calling thread.
template <typename T>
void nearest_centre_serial(const T* points, const T* centres, int32_t* cells, int64_t n, int64_t k, Isa isa);

VN_DECLARE_FOR_ISA(void nearest_centre(const float* points, const float* centres, int32_t* cells, int64_t n, int64_t k))
VN_DECLARE_FOR_ISA(void nearest_centre(const double* points, const double* centres, int32_t* cells, int64_t n,
                                       int64_t k))

}  // namespace voronerf
