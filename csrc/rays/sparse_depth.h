// How little of a ray's light comes from near a known point, and the gradient: s rays, m samples. Ray i owns
// samples offsets[i] : offsets[i + 1], counted from offsets[0]. The formulas are in voronerf/ops/sparse_depth_gradient.
#pragma once

#include <cstdint>

namespace voronerf {

struct SparseDepth {
  const float *density, *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                            // [s+1]
  const float* distances;                            // [s], NaN for none
  float nearby;
  int64_t s, m;
};

// loss: [1]; of_rays: [s], that of each; gradient: [m]. Throws std::invalid_argument for offsets that fall, or are of
// more or fewer samples than m.
void sparse_depth_gradient_cpu(const SparseDepth& in, float* loss, float* of_rays, float* gradient, int threads);

}  // namespace voronerf
