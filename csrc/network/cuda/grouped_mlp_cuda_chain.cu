// The forward pass of grouped_mlp on CUDA with values in registers from layer to layer (grouped_mlp_cuda_chain.h): the
// launches, the kernel that packs the weights, and that of rows with each warp's own products.
#include <algorithm>

#include "network/cuda/grouped_mlp_cuda_chain_kernel.h"
#include "network/cuda/grouped_mlp_cuda_tasks.h"

namespace voronerf {

namespace {

// Grid (k, layers, blocks of a layer).
template <bool kBfloat16>
__global__ void __launch_bounds__(kMlpLayerThreads)
    mlp_chain_pack_kernel(const MlpChainPlan plan, const MlpCudaData data, const MlpCudaParameters parameters,
                          const MlpStrays strays) {
  if (blockIdx.y == 0) mlp_prepare_rows(data, plan.task_rows, plan.tasks, strays);
  const int64_t cell = blockIdx.x;
  const MlpChainLayer& layer = plan.layers[blockIdx.y];
  unsigned char* piece = data.packed + cell * plan.packed_bytes + layer.piece;
  const float* weight = parameters.weights[layer.index] + cell * layer.width * layer.inputs;
  const float* bias = parameters.biases[layer.index];
  const int thread = blockIdx.z * kMlpLayerThreads + threadIdx.x, threads = gridDim.z * kMlpLayerThreads;
  for (int chunk = 0; chunk < chain_chunks(layer.width); ++chunk) {
    const int pairs = chain_pairs(chain_tiles(layer.width, chunk, layer.fresh));
    const int bytes = chain_piece_weights(layer.steps, pairs);
    for (int i = thread; i < bytes / 4; i += threads) {
      const int output = chunk * kChainChunk + chain_weight_output(pairs, 2 * i);
      int column = chain_weight_column(pairs, 2 * i), s = 0;
      while (column >= layer.sources[s].steps * kChainStep) column -= layer.sources[s++].steps * kChainStep;
      const MlpChainSource& source = layer.sources[s];
      float values[2] = {0.0f, 0.0f};
      for (int part = 0; part < 2; ++part) {
        const int feature = chain_source_feature(plan, source, column + part);
        if (output < layer.width && feature >= 0) {
          values[part] = weight[output * layer.inputs + source.column + feature];
        }
      }
      reinterpret_cast<uint32_t*>(piece)[i] = pack_halves<kBfloat16>(values[0], values[1]);
    }
    for (int i = thread; i < 16 * pairs; i += threads) {
      const int output = chunk * kChainChunk + i;
      const bool there = bias != nullptr && output < layer.width;
      reinterpret_cast<float*>(piece + bytes)[i] = there ? bias[cell * layer.width + output] : 0.0f;
    }
    piece += chain_piece_bytes(layer.steps, pairs);
  }
}

template <bool kBfloat16>
void pack(const MlpChainPlan& plan, const MlpCudaData& data, const MlpCudaParameters& parameters, void* stream) {
  int64_t words = 1;
  for (int l = 0; l < plan.layer_count; ++l) {
    words = std::max(words, int64_t{plan.layers[l].steps} * chain_pairs(8) * kChainQuad / 4);
  }
  const MlpStrays strays = {{data.out}, {plan.out_features}};
  const dim3 grid(static_cast<unsigned>(data.k), plan.layer_count,
                  mlp_cuda_layer_blocks(data.k, plan.layer_count, words));
  VN_LAUNCH((mlp_chain_pack_kernel<kBfloat16>), grid, kMlpLayerThreads, 0, stream, plan, data, parameters, strays);
}

}  // namespace

void mlp_chain_cuda(const MlpChainPlan& plan, MlpCudaData data, const MlpCudaParameters& parameters,
                    unsigned char* workspace, void* stream) {
  if (data.n == 0) return;
  const MlpCudaWorkspace parts = mlp_chain_workspace(plan, data.k);
  data.packed = workspace + parts.packed;
  data.first_task = reinterpret_cast<int32_t*>(workspace + parts.first_task);
  if (plan.precision == MlpPrecision::bfloat16) {
    pack<true>(plan, data, parameters, stream);
  } else {
    pack<false>(plan, data, parameters, stream);
  }
  if (plan.groups) {
    mlp_chain_groups_cuda(plan, data, stream);
  } else {
    mlp_chain_launch<ChainWarps>(plan, data, stream);
  }
}

}  // namespace voronerf
