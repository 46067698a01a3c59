// One linear layer for each cell, on samples sorted by cell, and its gradients.
//
// n samples, k cells, i inputs, o outputs. Tensors are contiguous, all in one storage type: float32, or bfloat16, which
// is read and written inside of the tiles. Sums are float32; with bfloat16 storage the operands of products are
// bfloat16 where the processor multiplies them faster, float32 elsewhere.
//   x [n,i], offsets [k+1], weight [k,o,i], bias [k,o] or null, out [n,o]
// Rows outside all cells (before offsets[0], from offsets[k] on) give 0. Results do not depend on the number of
// threads.
#pragma once

#include <cstdint>

#include "network/grouped_mlp.h"

namespace voronerf {

struct LinearInputs {
  const void* x;
  const int32_t* offsets;
  const void* weight;
  const void* bias;  // or null
  int64_t n, k, i, o;
  Activation activation;
  bool bfloat16;  // storage of every tensor
};

// Where gradients go; every element is written; null if not wanted. The gradient of the bias comes with the weight's.
struct LinearGradients {
  const void* out;  // [n,o], the incoming one
  void* x;
  void* weight;
  void* bias;
};

// Both throw std::invalid_argument for offsets that fall or exceed n.
void grouped_linear_cpu(const LinearInputs& inputs, void* out, Isa isa, int threads);

// The derivative of the activation uses recomputed outputs.
void grouped_linear_backward_cpu(const LinearInputs& inputs, const LinearGradients& gradients, Isa isa, int threads);

}  // namespace voronerf
