// What the forward and the backward kernel of grouped_mlp share: the rows of a task, activations, and a warp's rows
// through the network.
#pragma once

#include "network/cuda/grouped_mlp_cuda_encoding.h"

namespace voronerf {

constexpr int kMlpTiles = kMlpChunk / 8;  // 8-column tiles that a warp has in registers

// Lets a kernel have all the shared memory that a block may ask for. Always the same, since what one host thread sets
// must do for the launch of another.
template <typename Kernel>
void mlp_allow_shared(Kernel* kernel) {
  VN_CUDA_CHECK(
      cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, mlp_cuda_device().shared_bytes));
}

// Rows of a cell that a block works through.
struct MlpTask {
  int64_t begin, end;
  int cell;
};

// Rows of a cell, kept inside the batch whatever the offsets say.
__device__ inline int64_t mlp_cell_begin(const MlpCudaData& data, int64_t cell) {
  const int64_t first = data.offsets[cell];
  return first < 0 ? 0 : first > data.n ? data.n : first;
}
__device__ inline int64_t mlp_cell_rows(const MlpCudaData& data, int64_t cell) {
  const int64_t end = data.offsets[cell + 1] > data.n ? data.n : data.offsets[cell + 1];
  const int64_t rows = end - mlp_cell_begin(data, cell);
  return rows < 0 ? 0 : rows;
}

// Task number `task`, found in the map that the device made; false where there are fewer.
__device__ inline bool mlp_find_task(const MlpCudaData& data, int64_t task_rows, int64_t task, MlpTask& found) {
  int64_t low = 0, high = data.k;  // the last cell whose first task is not after this one
  if (task >= data.first_task[data.k]) return false;
  while (high - low > 1) {
    const int64_t middle = (low + high) / 2;
    if (data.first_task[middle] <= task) {
      low = middle;
    } else {
      high = middle;
    }
  }
  const int64_t begin = mlp_cell_begin(data, low), end = begin + mlp_cell_rows(data, low);
  found.cell = static_cast<int>(low);
  found.begin = begin + (task - data.first_task[low]) * task_rows;
  found.end = found.begin + task_rows < end ? found.begin + task_rows : end;
  return true;
}

__device__ inline int64_t mlp_source_row(const MlpCudaData& data, int64_t row) {
  return data.order == nullptr ? row : data.order[row];
}

// An index that a caller has given, which no host has read: what leaves [0, n) counts as the nearest within.
template <typename T>
__device__ inline T mlp_within(T index, int64_t n) {
  return index < 0 ? 0 : index < n ? index : static_cast<T>(n - 1);
}

// Raw features of a row.
__device__ inline const float* mlp_positions(const MlpCudaPlan& plan, const MlpCudaData& data, int64_t row) {
  return data.positions + mlp_source_row(data, row) * plan.positions.raw;
}
__device__ inline const float* mlp_directions(const MlpCudaPlan& plan, const MlpCudaData& data, int64_t row) {
  const int64_t source = mlp_source_row(data, row);
  return data.directions +
         (data.direction_index == nullptr ? source : mlp_within(data.direction_index[source], data.r)) *
             plan.directions.raw;
}

__device__ inline float mlp_activate(int activation, float x) {
  switch (static_cast<Activation>(activation)) {
    case Activation::relu:
      return x < 0.0f ? 0.0f : x;
    case Activation::softplus:
      return (x < 0.0f ? 0.0f : x) + log1pf(expf(-fabsf(x)));
    case Activation::sigmoid:
      return 1.0f / (1.0f + expf(-x));
    case Activation::sine:
      return sinf(x);
    default:
      return x;
  }
}

// Activations that are an instruction or two, which the kernels repeat for every register.
__device__ inline bool mlp_is_simple(int activation) { return activation <= static_cast<int>(Activation::relu); }
__device__ inline float mlp_activate_simply(int activation, float x) {
  return activation == static_cast<int>(Activation::relu) && x < 0.0f ? 0.0f : x;
}

// visit(tile, its sums) for every tile, by code that is there once: the others are long, and repeated for every
// register they would fill the cache of instructions. Registers cannot be indexed, so all sums move on by a tile each
// time.
template <int kRowTiles, int kTiles, typename Visit>
__device__ __forceinline__ void mlp_for_each_tile(MlpSums<kRowTiles, kTiles>& sums, const Visit& visit) {
#pragma unroll 1
  for (int tile = 0; tile < kTiles; ++tile) {
    MlpSums<kRowTiles, 1> each;
#pragma unroll
    for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
      for (int i = 0; i < 4; ++i) each[r][0][i] = sums[r][0][i];
    }
    visit(tile, each);
#pragma unroll
    for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
      for (int i = 0; i < 4; ++i) {
#pragma unroll
        for (int t = 0; t + 1 < kTiles; ++t) sums[r][t][i] = sums[r][t + 1][i];
        sums[r][kTiles - 1][i] = each[r][0][i];
      }
    }
  }
}

// What a gradient is multiplied by at a layer's value y (of a sine: at its kept derivative).
__device__ inline float mlp_times_slope(int activation, float gradient, float y) {
  switch (static_cast<Activation>(activation)) {
    case Activation::relu:
      return y > 0.0f ? gradient : 0.0f;  // a choice: an infinite gradient stops at what is inactive
    case Activation::softplus:
      return gradient * -expm1f(-y);
    case Activation::sigmoid:
      return gradient * (y * (1.0f - y));
    case Activation::sine:
      return gradient * y;
    default:
      return gradient;
  }
}

// A source of a layer in the warp's region.
struct MlpPlace {
  int value, stride;
};
__device__ inline MlpPlace mlp_place(const MlpCudaPlan& plan, int from) {
  if (from == kFromPositions) return {plan.positions.value, plan.positions.stride};
  if (from == kFromDirections) return {plan.directions.value, plan.directions.stride};
  return {plan.layers[from].value, plan.layers[from].stride};
}

// Copies a piece of packed weights to shared memory: `rows` rows of `bytes` bytes, both strides in bytes, all multiples
// of 16.
__device__ inline void mlp_copy(unsigned char* to, int to_stride, const unsigned char* from, int from_stride, int rows,
                                int bytes) {
  const int words = bytes / 16;
  for (int i = threadIdx.x; i < rows * words; i += blockDim.x) {
    const int row = i / words, word = i - row * words;
    *reinterpret_cast<float4*>(to + row * to_stride + 16 * word) =
        *reinterpret_cast<const float4*>(from + static_cast<int64_t>(row) * from_stride + 16 * word);
  }
}

// Rows of a warp through the network. `slot` is where weights are in shared memory, `packed` where in global memory.
// visit(layer, chunk, sums) sees every layer's results before they are rounded.
template <typename Products, int kRowTiles, typename Visit>
__device__ void mlp_run(const MlpCudaPlan& plan, typename Products::Element* region, typename Products::Element* slot,
                        const unsigned char* packed, const Visit& visit) {
  using Element = typename Products::Element;
  const int lane = threadIdx.x % 32, group = lane / 4, member = lane % 4;
  const float* biases = reinterpret_cast<const float*>(packed + sizeof(Element) * plan.packed_weights);
  for (int l = 0; l < plan.layer_count; ++l) {
    const MlpCudaLayer& layer = plan.layers[l];
    if (!layer.live) continue;
    for (int chunk = 0; chunk < layer.padded; chunk += kMlpChunk) {
      const int columns = layer.padded - chunk < kMlpChunk ? layer.padded - chunk : kMlpChunk;
      const Element* weights = slot + layer.weight + chunk * layer.weight_stride;
      if (!plan.resident) {
        __syncthreads();  // the piece before is read by all
        const int bytes = static_cast<int>(sizeof(Element)) * columns * layer.weight_stride;
        mlp_copy(reinterpret_cast<unsigned char*>(slot), 0,
                 packed + sizeof(Element) * (layer.weight + chunk * layer.weight_stride), 0, 1, bytes);
        __syncthreads();
        weights = slot;
      }
      MlpSums<kRowTiles, kMlpTiles> sums;
#pragma unroll
      for (int tile = 0; tile < kMlpTiles; ++tile) {
        const int column = 8 * tile + 2 * member;
        const bool there = column < columns;
        const float x = there ? biases[layer.bias + chunk + column] : 0.0f;
        const float y = there ? biases[layer.bias + chunk + column + 1] : 0.0f;
#pragma unroll
        for (int r = 0; r < kRowTiles; ++r) {
          sums[r][tile][0] = sums[r][tile][2] = x;
          sums[r][tile][1] = sums[r][tile][3] = y;
        }
      }
      for (int s = 0; s < layer.source_count; ++s) {
        const MlpCudaSource& source = layer.sources[s];
        const MlpPlace place = mlp_place(plan, source.from);
        Products::template multiply<false, false>(sums, region + place.value, place.stride, weights + source.packed,
                                                  layer.weight_stride, source.padded, columns / 8);
      }
      __syncwarp();  // the result may lie where a source was
      const auto at = [&](int r, int tile, int half) {
        return (16 * r + group + 8 * half) * layer.stride + chunk + 8 * tile + 2 * member;
      };
      if (mlp_is_simple(layer.activation)) {
#pragma unroll
        for (int tile = 0; tile < kMlpTiles; ++tile) {
          if (8 * tile >= columns) continue;
#pragma unroll
          for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
            for (int half = 0; half < 2; ++half) {
              float* pair = sums[r][tile] + 2 * half;
              pair[0] = mlp_activate_simply(layer.activation, pair[0]);
              pair[1] = mlp_activate_simply(layer.activation, pair[1]);
              Products::store(region + layer.value + at(r, tile, half), pair[0], pair[1]);
            }
          }
        }
      } else {
        mlp_for_each_tile(sums, [&](int tile, MlpSums<kRowTiles, 1>& each) {
          if (8 * tile >= columns) return;
#pragma unroll
          for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
            for (int half = 0; half < 2; ++half) {
              float* pair = each[r][0] + 2 * half;
              const int place = at(r, tile, half);
              if (layer.slope >= 0) Products::store(region + layer.slope + place, cosf(pair[0]), cosf(pair[1]));
              pair[0] = mlp_activate(layer.activation, pair[0]);
              pair[1] = mlp_activate(layer.activation, pair[1]);
              Products::store(region + layer.value + place, pair[0], pair[1]);
            }
          }
        });
      }
      visit(l, chunk, sums);
      __syncwarp();
    }
  }
}

}  // namespace voronerf
