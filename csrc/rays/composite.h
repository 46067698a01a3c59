// Volume rendering along rays: r rays, m samples, c channels. The samples of a ray are adjacent: ray i owns samples
// offsets[i] : offsets[i + 1], or s samples without offsets. The formulas are in voronerf/ops/composite.
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

// The first four members are the gradients of CompositeOutputs, null for zero. The other members receive the gradients
// of the inputs, null to skip one. `sigma` is never null, because it holds intermediate results. Every element is
// written.
struct CompositeGradients {
  const float *colour, *opacity, *depth, *weights;
  float *sigma, *rgb, *depths, *deltas;
  float* background;  // like the input
  float* left;        // [r], workspace; required if the input has a background
};

// Both CPU functions throw std::invalid_argument if offsets decrease or exceed m.
void composite_cpu(const CompositeInputs& in, const CompositeOutputs& out, Isa isa, int threads);
void composite_backward_cpu(const CompositeInputs& in, const CompositeGradients& gradients, Isa isa, int threads);

// The CUDA functions do not reject offsets that decrease or exceed m; they access no memory out of range.
void composite_cuda(const CompositeInputs& in, const CompositeOutputs& out, void* stream);
void composite_backward_cuda(const CompositeInputs& in, const CompositeGradients& gradients, void* stream);

}  // namespace voronerf
