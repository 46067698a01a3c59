// Adam on several parameters in one call. Apart from sparse_adam.h, which the files of each instruction set read.
#pragma once

#include <cstdint>
#include <vector>

#include "encoding/sparse_adam.h"

namespace voronerf {

// sparse_adam_cpu of each parameter, by its own rule.
void adam_cpu(const std::vector<SparseAdam>& rules, const float* const* gradients, float* const* parameters,
              float* const* means, float* const* squares, const std::vector<int64_t>& sizes, Isa isa, int threads);

}  // namespace voronerf
