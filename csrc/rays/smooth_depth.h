// A loss that pulls the depths of neighbouring unseen rays onto a plane, and its gradient: triples among r rays, m
// samples. Ray i owns samples offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/smooth_depth_gradient.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct SmoothDepth {
  const float *density, *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                            // [r+1]
  const float* far;                                  // [r]
  float factor, hidden;                              // hidden: transmittance up to which samples have no gradient
  float edge;  // scale of the robust loss of the logarithms, like `robust` for colours
  float density_scale;
  bool activated;  // the network's output is the density itself, else its value before the softplus
  RowCount triples, r, m;
};

// Adds to loss [1] and to the last column of gradient [m,4]. of_rays: [r], workspace. Throws std::invalid_argument if
// offsets decrease or exceed m, and then adds nothing.
void smooth_depth_gradient_cpu(const SmoothDepth& in, float* loss, float* gradient, float* of_rays, int threads);

}  // namespace voronerf
