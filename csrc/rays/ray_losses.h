// Losses along rays, with their gradients with respect to weights and densities: r rays, m samples. Ray i owns samples
// offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/ray_losses; rendered_gradient.h carries the gradients
// on to the outputs of the networks.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct SparseDepthInputs {
  const float *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                  // [r+1]
  const float* distances;                  // [s], distance of each of the first rays' points, NaN for none
  float nearby, factor;                    // factor: multiplies the mean over the s rays
  RowCount s, r, m;
};

struct SmoothDepthInputs {
  const float *depths, *weights;  // [m]
  const int32_t* offsets;         // [r+1]
  const float* far;               // [r]
  float factor;
  float edge;  // scale of the robust loss of the logarithms, like `robust` for colours
  RowCount triples, r, m;
};

struct SurfaceInputs {
  const float *depths, *deltas, *weights;  // [m]
  const int32_t* offsets;                  // [r+1]
  const float *near, *far;                 // [r]
  float distortion, orientation;           // factors of the two losses
  float hidden;                            // transmittance up to which samples are ignored
  RowCount r, m;
};

// These functions add to loss [1], of_weights [m] and of_density [m]. of_rays: [s] or [r], workspace. They throw
// std::invalid_argument if offsets decrease or exceed m, and then add nothing.
void sparse_depth_loss_cpu(const SparseDepthInputs& in, float* loss, float* of_weights, float* of_rays, int threads);
void smooth_depth_loss_cpu(const SmoothDepthInputs& in, float* loss, float* of_weights, float* of_rays, int threads);
void surface_loss_cpu(const SurfaceInputs& in, float* loss, float* of_weights, float* of_density, float* of_rays,
                      int threads);

}  // namespace voronerf
