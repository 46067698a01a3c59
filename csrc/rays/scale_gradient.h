// Multiplies the gradients of samples by the square of their distance, up to 1: m samples, c numbers each. Why is said
// in voronerf/ops/scale_gradient.
#pragma once

#include <cstdint>

#include "common/hd.h"
#include "common/row_count.h"

namespace voronerf {

// The factor of a sample; NaN stays.
VN_HD float gradient_share(float depth, float full) {
  const float share = depth / full, square = share * share;
  return square > 1.0f ? 1.0f : square;
}

// depths: [m]. gradient: [m,c].
void scale_gradient_cpu(const float* depths, float full, RowCount m, int64_t c, float* gradient, int threads);
void scale_gradient_cuda(const float* depths, float full, int64_t m, int64_t c, float* gradient, void* stream);

}  // namespace voronerf
