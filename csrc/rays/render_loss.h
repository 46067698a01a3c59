// The loss of rendered rays and its gradient, from the outputs of the networks: r rays, m samples. Ray i owns samples
// offsets[i] : offsets[i + 1]. The formulas are in voronerf/ops/render_loss.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

struct RenderLossInputs {
  const float* raw;         // [m,4]: colour and density, before sigmoid and softplus unless `activated`
  const float* deltas;      // [m]
  const int32_t* offsets;   // [r+1]
  const float* target;      // [r,3]
  const float* background;  // [r,3], or [3], or null
  bool background_per_ray;
  float density_scale;
  bool activated;    // raw holds colour and density themselves, without density_scale
  float hidden;      // transmittance up to which samples have no gradient
  float robust;      // scale of the robust loss (render_loss_math.h); 0 for squared errors
  RowCount triples;  // the last 3 * triples rays have no target: neither loss, error nor gradient
  RowCount r, m;
};

struct RenderLossOutputs {
  float* loss;      // [1]
  float* colour;    // [r,3]
  float* weights;   // [m]
  float* density;   // [m]
  float* error;     // [r]
  float* gradient;  // [m,4], of the loss with respect to raw
};

// Throws std::invalid_argument if offsets decrease or exceed m.
void render_loss_cpu(const RenderLossInputs& in, const RenderLossOutputs& out, Isa isa, int threads);

// Does not reject offsets that decrease or exceed m, and accesses no memory out of range.
void render_loss_cuda(const RenderLossInputs& in, const RenderLossOutputs& out, void* stream);

// These functions compute render_loss in two halves, for runs (pieces of rays). Here offsets and r describe the runs;
// target, background and triples are unused. run_sums_cpu computes partial sums [r,6]: colour as if nothing were in
// front, optical depth, depth of the first sample, ray. The answers [r,6] come from whole rays: the gradient of the
// loss with respect to the ray's colour, the loss due to light from behind the run, the optical depth in front, the
// error of the ray. `importance` is the error times the weights.
void run_sums_cpu(const RenderLossInputs& in, const float* depths, const int32_t* ray_index, float* density,
                  float* sums, Isa isa, int threads);
void run_gradients_cpu(const RenderLossInputs& in, const float* answers, float* gradient, float* weights,
                       float* importance, Isa isa, int threads);

}  // namespace voronerf
