// The kernels of grouped_linear, once for each instruction set (grouped_linear_isa.cpp).
#pragma once

#include "common/isa.h"
#include "network/cpu/grouped_mlp_plan.h"

namespace voronerf {

// A call in plain numbers: sizes, pointers, and where a thread's workspace holds what, in floats from its start.
struct LinearCall {
  MlpPlanLayer layer;     // sizes and activation, as the packing of weights and the activations read them
  MlpPlanSource source;   // its one source, x
  int64_t tile;           // rows
  int64_t inputs_padded;  // to whole pairs of vectors
  bool bfloat16, half;    // storage; operands
  bool backward;
  int64_t wide, input, value, slope, gradient, input_gradient, scratch_input, scratch_output, own_partial;
  int64_t workspace;  // floats a thread needs
  int64_t partial;    // floats of the partial gradients of a task: [inputs][padded], then [padded] for the bias
  const void *x, *weight, *bias, *grad_out;
  void *out, *grad_x, *grad_weight, *grad_bias;
};

// Packs a cell's weights into a workspace.
VN_DECLARE_FOR_ISA(void linear_pack(const LinearCall& call, int64_t cell, float* workspace))

// Rows [begin, end) of the packed cell.
VN_DECLARE_FOR_ISA(void linear_forward(const LinearCall& call, int64_t begin, int64_t end, float* workspace))

// Their gradients; those of the parameters fill `partial`, if they are wanted.
VN_DECLARE_FOR_ISA(void linear_backward(const LinearCall& call, int64_t begin, int64_t end, float* workspace,
                                        float* partial))

// The same with bfloat16 products.
#if VN_HAS_HALF
namespace avx512 {
void linear_half_pack(const LinearCall& call, int64_t cell, float* workspace);
void linear_half_forward(const LinearCall& call, int64_t begin, int64_t end, float* workspace);
void linear_half_backward(const LinearCall& call, int64_t begin, int64_t end, float* workspace, float* partial);
}  // namespace avx512
#endif

// Gradients of a cell's parameters: the sum of `count` partials in their order, which the first of them then holds. The
// workspace is one of a thread.
VN_DECLARE_FOR_ISA(void linear_reduce(const LinearCall& call, int64_t cell, float* partials, int64_t count,
                                      float* workspace))

}  // namespace voronerf
