// Turns gradients of rendered rays into gradients of the networks' outputs: r rays, m samples. Ray i owns samples
// offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/rendered_gradient.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct RenderedGradient {
  const float* raw;                        // [m,4]
  const float *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                  // [r+1]
  const float* background;                 // [r,3], or [3], or null
  bool background_per_ray;
  const float *of_colour, *of_opacity, *of_depth;  // [r,3], [r], [r]; null for zero
  const float *of_weights, *of_rgb, *of_density;   // [m], [m,3], [m]; null for zero
  float hidden;                                    // if positive: transmittance up to which samples have no gradient
  float density_scale;
  bool activated;  // raw holds colours and densities themselves, else their values before activation
  RowCount r, m;
};

// Adds to gradient [m,4]. Throws std::invalid_argument if offsets decrease or exceed m, and then adds nothing.
void rendered_gradient_cpu(const RenderedGradient& in, float* gradient, int threads);

}  // namespace voronerf
