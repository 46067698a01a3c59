// The loss of rendered rays and its gradient, from the outputs of the networks: r rays, m samples. Ray i owns samples
// offsets[i] : offsets[i + 1]. What it computes is said in voronerf/ops/render_loss.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

struct RenderLossInputs {
  const float* raw;         // [m,4]: colour before its sigmoid, density before its softplus; or both as they are
  const float* deltas;      // [m]
  const int32_t* offsets;   // [r+1]
  const float* target;      // [r,3]
  const float* background;  // [r,3], or [3], or null
  bool background_per_ray;
  float density_scale;
  bool activated;    // colour and density as they are, without scale
  float hidden;      // share of the light; samples that no more than it reaches have no gradient
  float robust;      // scale of the errors that count less than squared, see render_loss_math.h; 0 for none
  RowCount triples;  // the last 3 * triples rays have no colour to learn: neither loss, error nor gradient
  RowCount r, m;
};

struct RenderLossOutputs {
  float* loss;      // [1]
  float* colour;    // [r,3]
  float* weights;   // [m]
  float* density;   // [m]
  float* error;     // [r]
  float* gradient;  // [m,4], of the loss to raw
};

// Throws std::invalid_argument for offsets that fall or exceed m.
void render_loss_cpu(const RenderLossInputs& in, const RenderLossOutputs& out, Isa isa, int threads);

// Offsets that fall or exceed m are not refused: samples outside are not touched.
void render_loss_cuda(const RenderLossInputs& in, const RenderLossOutputs& out, void* stream);

// The same in two halves, for runs, which are pieces of rays: offsets are theirs, r counts them, and there is neither
// target, background nor triples. The first gives the partial sums [r,6]: colour as if nothing were in front, optical
// depth, depth of the first sample, ray. What is known of whole rays answers each sum with [r,6]: the gradient of the
// loss to the ray's colour, what the light behind the run adds to it, the optical depth in front, the error of the ray.
// `importance` is that error times the weights.
void run_sums_cpu(const RenderLossInputs& in, const float* depths, const int32_t* ray_index, float* density,
                  float* sums, Isa isa, int threads);
void run_gradients_cpu(const RenderLossInputs& in, const float* answers, float* gradient, float* weights,
                       float* importance, Isa isa, int threads);

}  // namespace voronerf
