// The kernels of sparse_adam, once for each instruction set: a step of entries [begin, end), and whether the magnitudes
// of a gradient [n] are all below a limit.
#pragma once

#include "encoding/sparse_adam.h"

namespace voronerf {

VN_DECLARE_FOR_ISA(void sparse_adam_block(const SparseAdam& rule, const float* gradient, float* parameter, float* mean,
                                          float* square, int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(bool sparse_adam_all_below(float limit, const float* gradient, int64_t n))

}  // namespace voronerf
