// How little of a ray's light comes from near a known point, and the gradient: s of r rays, m samples. Ray i owns
// samples offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/sparse_depth_gradient.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct SparseDepth {
  const float *density, *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                            // [r+1]
  const float* distances;                            // [s], of the points of the first rays, NaN for none
  float nearby, factor;                              // the latter on the mean over the s rays
  float density_scale;
  bool activated;  // the gradient is to the density itself, else to what comes before its softplus
  RowCount s, r, m;
};

// Adds to loss: [1] and to the last column of gradient: [m,4]. of_rays: [s], working memory. Throws
// std::invalid_argument for offsets that fall or exceed m, and adds nothing then.
void sparse_depth_gradient_cpu(const SparseDepth& in, float* loss, float* gradient, float* of_rays, int threads);

}  // namespace voronerf
