// The CPU kernels of the hash encoding, on the calling thread.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "encoding/hash_encode_math.h"

namespace voronerf {

constexpr int64_t kHashBlock = 64;  // points of a block, whose corners stay in cache

// The kernels process points `begin` to `end`. Rows of the result [n, levels x features] and of its gradient are
// `stride` floats apart.
VN_DECLARE_FOR_ISA(void hash_encode_rows(const HashEncoding& in, float* out, int64_t stride, int64_t begin,
                                         int64_t end))

// Computes the features of one level, and writes them to the beginning of each row.
VN_DECLARE_FOR_ISA(void hash_encode_level(const HashEncoding& in, int64_t level, float* out, int64_t stride,
                                          int64_t begin, int64_t end))

// Adds the points' gradients of one level's entries to of_table.
VN_DECLARE_FOR_ISA(void hash_encode_level_backward(const HashEncoding& in, int64_t level, const float* gradient,
                                                   int64_t stride, int64_t begin, int64_t end, float* of_table))

// Writes the gradients with respect to the positions. of_positions may be the memory of the positions.
VN_DECLARE_FOR_ISA(void hash_encode_positions_backward(const HashEncoding& in, const float* gradient, int64_t stride,
                                                       float* of_positions, int64_t begin, int64_t end))

}  // namespace voronerf
