// How far the depths of neighbouring rays are from a plane where no picture says, and the gradient: triples of r rays,
// m samples.
// Ray i owns samples offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/smooth_depth_gradient.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct SmoothDepth {
  const float *density, *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                            // [r+1]
  const float* far;                                  // [r]
  float factor, hidden;                              // the last: samples that no more light reaches have no gradient
  float edge;                                        // scale of the logarithms, as `robust` of colours
  float density_scale;
  bool activated;  // the gradient is to the density itself, else to what comes before its softplus
  RowCount triples, r, m;
};

// Adds to loss: [1] and to the last column of gradient: [m,4]. of_rays: [r], working memory. Throws
// std::invalid_argument for offsets that fall or exceed m, and adds nothing then.
void smooth_depth_gradient_cpu(const SmoothDepth& in, float* loss, float* gradient, float* of_rays, int threads);

}  // namespace voronerf
