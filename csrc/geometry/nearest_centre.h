// Nearest centre: points [n,d], centres [k,d] -> cells [n], d = 1 to 4. The result is exact. Ties go to the lowest
// index, and non-finite points to cell 0 (nearest_centre_math.h). k >= 1; n = 0 is legal.
//
// index: an index of the centres (centre_index.h) with `words` entries, or null. Without an index the CPU builds one
// for the call if it pays. Returns false if d is out of range or the index does not match the centres' shape. On CUDA
// the host checks only the index's size; if its head does not match, all cells are -1.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"
#include "geometry/centre_index.h"

namespace voronerf {

template <typename T>
bool nearest_centre_cpu(const T* points, const T* centres, const int32_t* index, int32_t* cells, RowCount n, int64_t k,
                        int64_t d, int64_t words, Isa isa, int threads);
// rows: [1], the number of leading points to locate (other points get -1), or null to locate all points.
template <typename T>
bool nearest_centre_cuda(const T* points, const T* centres, const int32_t* index, const int32_t* rows, int32_t* cells,
                         int64_t n, int64_t k, int64_t d, int64_t words, void* stream);

// Searches an index on the calling thread.
template <typename T>
void search_index_serial(const T* points, const int32_t* index, int32_t* cells, int64_t n,
                         const CentreIndexShape& shape, int d, Isa isa);

// Compares points with all centres, in three coordinates, on the calling thread.
template <typename T>
void nearest_centre_serial(const T* points, const T* centres, int32_t* cells, int64_t n, int64_t k, Isa isa);

VN_DECLARE_FOR_ISA(void nearest_centre(const float* points, const float* centres, int32_t* cells, int64_t n, int64_t k))
VN_DECLARE_FOR_ISA(void nearest_centre(const double* points, const double* centres, int32_t* cells, int64_t n,
                                       int64_t k))

}  // namespace voronerf
