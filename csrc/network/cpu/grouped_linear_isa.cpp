// The CPU kernels of grouped_linear, once for each instruction set.
//
// One layer has as many bytes as flops to move: what has the form of an operand is read where it lies, and results go
// straight to where they belong, from registers. float32 rows of whole vectors do so, and with bfloat16 products rows
// of an even width (read) or of whole vectors (written), since such a row is pairs already; anything else passes
// through a tile of rows in the first cache level.
#include "network/cpu/grouped_linear_isa.h"

#define VN_HALF 0
#include "network/cpu/grouped_linear_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void linear_pack(const LinearCall& call, int64_t cell, float* workspace) { pack_linear(call, cell, workspace); }

void linear_forward(const LinearCall& call, int64_t begin, int64_t end, float* workspace) {
  run_linear_forward(call, begin, end, workspace);
}

void linear_backward(const LinearCall& call, int64_t begin, int64_t end, float* workspace, float* partial) {
  run_linear_backward(call, begin, end, workspace, partial);
}

void linear_reduce(const LinearCall& call, int64_t cell, float* partials, int64_t count, float* workspace) {
  const int64_t width = call.layer.width, depth = call.layer.depth, padded = call.layer.padded, size = width * depth;
  for (int64_t part = 1; part < count; ++part) {
    const float* next = partials + part * call.partial;
    for (int64_t i = 0; i < call.partial; i += kLanes) store(partials + i, load(partials + i) + load(next + i));
  }
  float* wide =
      call.bfloat16 ? workspace + call.wide : static_cast<float*>(call.grad_weight) + cell * size;  // [o][depth]
  const float* bias = partials + depth * padded;
  int64_t c = 0;
  for (; count > 0 && c + 4 <= depth; c += 4) transpose_four(partials + c * padded, padded, width, wide + c, depth);
  for (; c < depth; ++c) {
    for (int64_t o = 0; o < width; ++o) wide[o * depth + c] = count > 0 ? partials[c * padded + o] : 0.0f;
  }
  if (call.bfloat16) round_row(wide, size, static_cast<uint16_t*>(call.grad_weight) + cell * size);
  if (call.grad_bias == nullptr) return;
  float* zeros = workspace + call.wide;
  if (count == 0) {
    for (int64_t o = 0; o < width; ++o) zeros[o] = 0.0f;
    bias = zeros;
  }
  write_row(call, bias, width, call.grad_bias, cell * width);
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
