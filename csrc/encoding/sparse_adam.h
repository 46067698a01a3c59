// Adam on the entries that have a gradient. n entries; the formula is in voronerf/ops/sparse_adam.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

struct SparseAdam {
  float step_size;        // the learning rate, corrected for the moments' start at zero
  float decay, decay_sq;  // of the moments
  float epsilon;          // corrected likewise
  bool every;             // on the CPU: entries without a gradient move on by their moments, which decay, as torch's do
};

// gradient: [n] -> parameter, mean, square: [n], updated in place where the gradient is not zero.
void sparse_adam_cpu(const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square,
                     int64_t n, Isa isa, int threads);
void sparse_adam_cuda(const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square,
                      int64_t n, void* stream);

}  // namespace voronerf
