// How far the light of rays is from that of one surface, and the gradient: r rays, m samples. Ray i owns samples
// offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/surface_gradient.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct Surface {
  const float *density, *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                            // [r+1]
  const float *near, *far;                           // [r]
  float distortion, orientation;                     // factors of the two losses
  float hidden;                                      // samples that no more light reaches count nowhere
  float density_scale;
  bool activated;  // the gradient is to the density itself, else to what comes before its softplus
  RowCount r, m;
};

// Adds to loss: [1] and to the last column of gradient: [m,4]. of_rays: [r], working memory. Throws
// std::invalid_argument for offsets that fall or exceed m, and adds nothing then.
void surface_gradient_cpu(const Surface& in, float* loss, float* gradient, float* of_rays, int threads);

}  // namespace voronerf
