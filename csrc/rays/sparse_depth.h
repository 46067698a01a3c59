// A loss for rays that end at known points, and its gradient: the first s of r rays, m samples. The loss of a ray is
// small if its light comes from samples near the point. Ray i owns samples offsets[i] : offsets[i + 1]. The formulas
// are in voronerf/ops/sparse_depth_gradient.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct SparseDepth {
  const float *density, *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                            // [r+1]
  const float* distances;                            // [s], distance of each ray's point, NaN for none
  float nearby, factor;                              // factor: multiplies the mean over the s rays
  float density_scale;
  bool activated;  // the network's output is the density itself, else its value before the softplus
  RowCount s, r, m;
};

// Adds to loss [1] and to the last column of gradient [m,4]. of_rays: [s], workspace. Throws std::invalid_argument if
// offsets decrease or exceed m, and then adds nothing.
void sparse_depth_gradient_cpu(const SparseDepth& in, float* loss, float* gradient, float* of_rays, int threads);

}  // namespace voronerf
