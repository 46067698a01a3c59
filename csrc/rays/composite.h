// Volume rendering along rays: r rays, m samples, c channels. Samples of a ray lie side by side: ray i owns samples
// offsets[i] : offsets[i + 1], or without offsets s of them. What it computes is said in voronerf/ops/composite.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

struct CompositeInputs {
  const float* sigma;       // [m]
  const float* rgb;         // [m,c]
  const float* depths;      // [m]
  const float* deltas;      // [m]
  const int32_t* offsets;   // [r+1], or null
  const float* background;  // [r,c], or [c], or null
  bool background_per_ray;
  RowCount r;
  int64_t s;
  RowCount m;
  int64_t c;
};

struct CompositeOutputs {
  float* colour;   // [r,c]
  float* opacity;  // [r]
  float* depth;    // [r]
  float* weights;  // [m]
};

// The first four are the gradients of CompositeOutputs, null for zero; the rest receive those of the inputs, null where
// not wanted. That to sigma is always there: it holds intermediate results. Every element is written.
struct CompositeGradients {
  const float *colour, *opacity, *depth, *weights;
  float *sigma, *rgb, *depths, *deltas;
  float* background;  // like the input
  float* left;        // [r], workspace; there if the input has a background
};

// Throw std::invalid_argument for offsets that fall or exceed m.
void composite_cpu(const CompositeInputs& in, const CompositeOutputs& out, Isa isa, int threads);
void composite_backward_cpu(const CompositeInputs& in, const CompositeGradients& gradients, Isa isa, int threads);

// Offsets that fall or exceed m are not refused: samples outside are not touched.
void composite_cuda(const CompositeInputs& in, const CompositeOutputs& out, void* stream);
void composite_backward_cuda(const CompositeInputs& in, const CompositeGradients& gradients, void* stream);

}  // namespace voronerf
