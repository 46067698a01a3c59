// The forward pass of grouped_mlp on CUDA with values in registers from layer to layer (grouped_mlp_cuda_chain.h): the
// kernel that packs the weights, that of rows, a block a task, a warp 32 rows at a time through all layers, and the
// launches.
#include <algorithm>

#include "network/cuda/grouped_mlp_cuda_chain_tile.h"
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

// Begins to copy a piece of a cell's weights, a chunk of layer l, to a slot in shared memory.
__device__ inline void chain_fetch(const MlpChainPlan& plan, int l, int chunk, const unsigned char* packed,
                                   unsigned char* slot) {
  const MlpChainLayer& layer = plan.layers[l];
  const int bytes = chain_piece_bytes(layer.steps, chain_pairs(chain_tiles(layer.width, chunk, layer.fresh)));
  // Of two chunks the first is whole.
  packed += layer.piece + chunk * chain_piece_bytes(layer.steps, chain_pairs(kChainChunk / 8));
  for (int at = 16 * thread_again(); at < bytes; at += 16 * kChainRows * plan.warps) {
    copy_async(slot + at, packed + at, true);
  }
  copy_commit();
}

// Waits for the piece in one slot, and begins to copy the one after it, if there is one, to the other.
__device__ inline void chain_next_piece(const MlpChainPlan& plan, int l, int chunk, bool last_tile,
                                        const unsigned char* packed, unsigned char* other) {
  copy_wait<0>();
  __syncthreads();  // the piece is there for all, and all are done with the one before
  if (chunk + 1 < chain_chunks(plan.layers[l].width)) {
    chain_fetch(plan, l, chunk + 1, packed, other);
  } else if (l + 1 < plan.layer_count) {
    chain_fetch(plan, l + 1, 0, packed, other);
  } else if (!last_tile) {
    chain_fetch(plan, 0, 0, packed, other);
  }
}

// Threads of a block at most, by the registers that they need.
constexpr int chain_threads(int width) { return width == 32 ? 512 : width == 64 ? 384 : 256; }

// Results of a chunk of `kTiles` tiles of a layer's outputs, for the rows of a warp: into the output, into `held`, and
// where they are stored. Those of the first of two chunks are stored in any case, since the second reads what is held.
template <bool kBfloat16, int kTiles, int kSteps>
__device__ __forceinline__ void chain_run(const MlpChainPlan& plan, const MlpCudaData& data, int l, int chunk,
                                          const unsigned char* piece, unsigned char* region, MlpChainRows rows,
                                          MlpFragment (&held)[kSteps]) {
  constexpr int kPairs = chain_pairs(kTiles), kStride = kPairs * kChainQuad, kChunkSteps = kChainChunk / kChainStep;
  const MlpChainLayer& layer = plan.layers[l];
  const unsigned char* weights = piece + threadIdx.x % 32 * 16;
  MlpSums<2, kTiles> sums;
  chain_begin(sums, reinterpret_cast<const float*>(piece + chain_piece_weights(layer.steps, kPairs)));
  const bool relu = layer.activation == static_cast<int>(Activation::relu), simple = mlp_is_simple(layer.activation);
  int s = 0;
  do {
    const MlpChainSource& source = layer.sources[s];
    if (source.from == MlpChainFrom::held) {
      if (source.steps == kSteps) {
        chain_multiply_steps<kBfloat16, true>(sums, held, kSteps, weights);
      } else {
        chain_multiply_steps<kBfloat16, false>(sums, held, source.steps, weights);
      }
      weights += source.steps * kStride;
      continue;
    }
    if constexpr (kTiles >= kChainInputTiles) {
      if (source.from != MlpChainFrom::stored && (source.region < 0 || (source.compute && chunk == 0))) {
        const bool directions = source.from == MlpChainFrom::directions;
        const MlpChainInput input = directions ? plan.directions : plan.positions;
        const float* from = directions ? data.directions : data.positions;
        int of_input[4];
        chain_source_rows(data, rows, directions ? data.direction_index : nullptr, of_input);
        MlpChainUnit unit = chain_first_unit(input);
#pragma unroll 1
        for (int step = 0; step < source.steps; ++step) {
          MlpFragment encoded[1];
          chain_encode<kBfloat16>(input, from, of_input, unit, encoded[0]);
          chain_next_unit(input, unit);
          __syncwarp();  // units are of different kinds; products want all lanes
          if (source.region >= 0) chain_store(region + source.region, step, encoded[0]);
          chain_multiply<kBfloat16>(sums, encoded[0], weights);
          weights += kStride;
        }
        continue;
      }
    }
#pragma unroll 1
    for (int step = 0; step < source.steps; ++step) {
      MlpFragment stored[1];
      chain_load(region + source.region, step, stored[0]);
      chain_multiply<kBfloat16>(sums, stored[0], weights);
      weights += kStride;
    }
  } while (++s < layer.source_count);  // there is one at least
  if (!simple) chain_activate(sums, layer.activation);
  if (layer.among) {
    if (relu) chain_relu(sums);
    int of_output[4];
    chain_source_rows(data, rows, nullptr, of_output);
    for (int o = 0; o < plan.output_count; ++o) {
      if (plan.outputs[o] != l) continue;
      float* to = data.out + plan.output_columns[o] + chunk * kChainChunk;
      chain_write(sums, to, plan.out_features, layer.width - chunk * kChainChunk, of_output);
    }
    __syncwarp();
  }
  if (!layer.read) return;
  if (layer.held && layer.width <= kChainChunk) {
    // Into its place at once: copies would be as many instructions as the roundings.
    chain_round<kBfloat16>(sums, relu, held);
    if (layer.region >= 0) chain_store_steps<kPairs>(region + layer.region, held);
    return;
  }
  MlpFragment values[kPairs];
  chain_round<kBfloat16>(sums, relu, values);
  if (kSteps > kChunkSteps && layer.held && chunk > 0) {
    // The first chunk has waited in the region, since this one has read what was held before.
    chain_load_steps<kChunkSteps>(region + layer.region, held);
    chain_copy<kChunkSteps>(held, values);
  }
  if (layer.region >= 0) {
    unsigned char* to = region + layer.region + chunk * kChunkSteps * 2 * kChainQuad;
    chain_store_steps<kPairs>(to, values);
  }
}

template <bool kBfloat16, int kWidth>
__device__ __forceinline__ void chain_rows(const MlpChainPlan& plan, const MlpCudaData& data) {
  constexpr int kMost = kWidth < kChainChunk ? kWidth / 8 : kChainChunk / 8;  // tiles of a chunk
  MlpTask task;
  // The whole block; no rows are what offsets that fall can make.
  if (!mlp_find_task(data, plan.task_rows, blockIdx.x, task) || task.begin >= task.end) return;
  VN_DYN_SHARED(unsigned char, shared);
  const unsigned char* packed = data.packed + static_cast<unsigned>(task.cell) * plan.packed_bytes;
  int slot = 0;
  if (plan.resident) {
    for (int at = 16 * threadIdx.x; at < plan.packed_bytes; at += 16 * blockDim.x) {
      copy_async(shared + at, packed + at, true);
    }
    copy_commit();
    copy_wait<0>();
    __syncthreads();
  } else {
    chain_fetch(plan, 0, 0, packed, shared);
  }
  const int step = kChainRows * plan.warps, before = threadIdx.x / 32 * kChainRows;  // before: rows of other warps
  unsigned char* region = shared + plan.weights + threadIdx.x / 32 * plan.region;
  MlpChainRows rows = {static_cast<unsigned>(task.begin) + before, static_cast<int>(task.end - task.begin) - before};
  // As long as any warp of the block has rows, since pieces want all of them.
  for (; rows.count + thread_again() / 32 * kChainRows > 0; rows.first += step, rows.count -= step) {
    if (plan.resident && rows.count <= 0) return;
    MlpFragment held[kWidth / kChainStep];
    const unsigned char* piece = shared;
    for (int l = 0; l < plan.layer_count; ++l) {
      const MlpChainLayer& layer = plan.layers[l];
      for (int chunk = 0; chunk < chain_chunks(layer.width); ++chunk) {
        const int tiles = chain_tiles(layer.width, chunk, layer.fresh);
        if (!plan.resident) {
          piece = shared + slot * plan.slot;
          slot ^= 1;
          chain_next_piece(plan, l, chunk, rows.count + thread_again() / 32 * kChainRows <= step, packed,
                           shared + slot * plan.slot);
        }
        chain_with_tiles<kMost>(tiles, [&](auto count) {
          chain_run<kBfloat16, decltype(count)::value>(plan, data, l, chunk, piece, region, rows, held);
        });
        piece += chain_piece_bytes(layer.steps, chain_pairs(tiles));
      }
    }
  }
}

template <bool kBfloat16, int kWidth>
__global__ void __launch_bounds__(chain_threads(kWidth), 1)
    mlp_chain_kernel(const MlpChainPlan plan, const MlpCudaData data) {
  chain_rows<kBfloat16, kWidth>(plan, data);
}

template <bool kBfloat16>
void launch(const MlpChainPlan& plan, const MlpCudaData& data, const MlpCudaParameters& parameters, void* stream) {
  pack<kBfloat16>(plan, data, parameters, stream);
  const auto run = [&](auto kernel) {
    mlp_allow_shared(kernel);
    VN_LAUNCH(kernel, static_cast<unsigned>(plan.tasks), 32 * plan.warps, plan.shared_bytes, stream, plan, data);
  };
  run(plan.width == 32   ? mlp_chain_kernel<kBfloat16, 32>
      : plan.width == 64 ? mlp_chain_kernel<kBfloat16, 64>
                         : mlp_chain_kernel<kBfloat16, 128>);
}

}  // namespace

void mlp_chain_cuda(const MlpChainPlan& plan, MlpCudaData data, const MlpCudaParameters& parameters,
                    unsigned char* workspace, void* stream) {
  if (data.n == 0) return;
  const MlpCudaWorkspace parts = mlp_chain_workspace(plan, data.k);
  data.packed = workspace + parts.packed;
  data.first_task = reinterpret_cast<int32_t*>(workspace + parts.first_task);
  if (plan.precision == MlpPrecision::bfloat16) {
    launch<true>(plan, data, parameters, stream);
  } else {
    launch<false>(plan, data, parameters, stream);
  }
}

}  // namespace voronerf
