// The CPU kernels of grouped_mlp, once for each instruction set.
//
// A tile of samples goes through all layers while its values stay in the first two cache levels; nothing of the size of
// n times a layer is ever written. A cell's weights are packed once by each thread that works on it, [inputs][outputs]
// in panels, so that the products (gemm_tile.h) read them in order. The backward pass computes the tile's activations
// again, then walks the layers from the last to the first: parameter gradients are summed over all tiles of a task in
// one partial, which stays in cache as well.
#include "network/cpu/grouped_mlp_isa.h"

#define VN_HALF 0
#include "network/cpu/grouped_mlp_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void mlp_prepare(const MlpPlan& plan, float* workspace) {
  const MlpPlanInput* inputs[] = {&plan.positions, &plan.directions};
  for (const MlpPlanInput* input : inputs) {
    if (input->used && has_octaves(*input)) {
      encode_table(workspace + input->table, input->value.stride, columns_of(*input));
    }
  }
}

void mlp_pack(const MlpPlan& plan, const MlpData& data, int64_t cell, float* workspace) {
  pack_cell(plan, data, cell, workspace);
}

void mlp_forward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end, float* workspace) {
  run_forward(plan, data, cell, begin, end, workspace);
}

void mlp_backward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end, float* workspace,
                  float* partial) {
  run_backward(plan, data, cell, begin, end, workspace, partial);
}

void mlp_reduce(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t l, float* partials, int64_t count) {
  const MlpPlanLayer& layer = plan.layers[l];
  float* weights = data.grad_weights[l] + cell * layer.width * layer.depth;
  float* bias = data.grad_biases[l] == nullptr ? nullptr : data.grad_biases[l] + cell * layer.width;
  if (count == 0 || !layer.live) {
    for (int64_t i = 0; i < layer.width * layer.depth; ++i) weights[i] = 0.0f;
    for (int64_t o = 0; bias != nullptr && o < layer.width; ++o) bias[o] = 0.0f;
    return;
  }
  float* sum = partials + layer.partial;
  const int64_t size = (layer.depth + 1) * layer.padded;  // the bias follows the weights
  for (int64_t part = 1; part < count; ++part) {
    const float* next = sum + part * plan.partial;
    for (int64_t i = 0; i < size; i += kLanes) store(sum + i, load(sum + i) + load(next + i));
  }
  for (int64_t i = 0; i < layer.source_count; ++i) {
    const MlpPlanSource& s = layer.sources[i];
    const float* from = sum + s.row * layer.padded;
    float* to = weights + s.row;
    const int64_t by_o = s.by_outputs ? padded_width(s) : 1, by_input = s.by_outputs ? 1 : layer.padded;
    int64_t first = 0;
    for (; !s.by_outputs && first + 4 <= s.width; first += 4) {
      transpose_four(from + first * by_input, by_input, layer.width, to + first, layer.depth);
    }
    for (int64_t o = 0; o < layer.width; ++o) {
      for (int64_t c = first; c < s.width; ++c) to[o * layer.depth + c] = from[c * by_input + o * by_o];
    }
  }
  for (int64_t o = 0; bias != nullptr && o < layer.width; ++o) bias[o] = partials[layer.partial_bias + o];
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
