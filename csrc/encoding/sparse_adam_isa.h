// The kernel of sparse_adam, once for each instruction set: entries [begin, end).
#pragma once

#include "encoding/sparse_adam.h"

namespace voronerf {

VN_DECLARE_FOR_ISA(void sparse_adam_block(const SparseAdam& rule, const float* gradient, float* parameter, float* mean,
                                          float* square, int64_t begin, int64_t end))

}  // namespace voronerf
