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

}  // namespace voronerf
