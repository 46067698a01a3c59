// The distortion loss and the orientation loss of rays, and their gradient: r rays, m samples. Ray i owns samples
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
  float hidden;                                      // transmittance up to which samples are ignored
  float density_scale;
  bool activated;  // the network's output is the density itself, else its value before the softplus
  RowCount r, m;
};

// Adds to loss [1] and to the last column of gradient [m,4]. of_rays: [r], workspace. Throws std::invalid_argument if
// offsets decrease or exceed m, and then adds nothing.
void surface_gradient_cpu(const Surface& in, float* loss, float* gradient, float* of_rays, int threads);

}  // namespace voronerf
