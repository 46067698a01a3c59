// The backward pass of grouped_mlp on CUDA. A tile's values are computed again and all kept in shared memory; then the
// layers are gone through from the last to the first. A layer's gradient is gathered from the layers that read it,
// summed in registers with the one that comes from outside, and put where the layer's values were, which nobody needs
// any more. Weight gradients run over the rows of all warps, hence two barriers a layer; they are added up in the
// task's own partial in global memory, by the same thread each time, so that no order is left to chance.
#pragma once

#include "network/cuda/grouped_mlp_cuda_backward.h"
#include "network/cuda/grouped_mlp_cuda_hash.h"

namespace voronerf {

namespace {

// sums [rows][columns] of the gradient of a source, columns from `chunk` on: what comes back from all layers that read
// it.
template <typename Products, int kRowTiles>
__device__ void mlp_gather(const MlpCudaPlan& plan, typename Products::Element* region,
                           typename Products::Element* slot, const unsigned char* packed, int from, int chunk,
                           int columns, MlpSums<kRowTiles, kMlpTiles>& sums) {
  using Element = typename Products::Element;
  for (int c = from < 0 ? 0 : from + 1; c < plan.layer_count; ++c) {
    const MlpCudaLayer& reader = plan.layers[c];
    if (!reader.live) continue;
    for (int s = 0; s < reader.source_count; ++s) {
      const MlpCudaSource& source = reader.sources[s];
      if (source.from != from) continue;
      const int begin = reader.weight + source.packed + chunk;
      const Element* weights = slot + begin;
      int stride = reader.weight_stride;
      if (!plan.resident) {
        __syncthreads();  // the piece before is read by all
        stride = kMlpChunk + Products::kSkew;
        mlp_copy(reinterpret_cast<unsigned char*>(slot), static_cast<int>(sizeof(Element)) * stride,
                 packed + sizeof(Element) * begin, static_cast<int>(sizeof(Element)) * reader.weight_stride,
                 reader.padded, static_cast<int>(sizeof(Element)) * columns);
        __syncthreads();
        weights = slot;
      }
      Products::template multiply<false, true>(sums, region + reader.value, reader.stride, weights, stride,
                                               reader.padded, columns / 8);
    }
  }
}

template <int kRowTiles, int kTiles>
__device__ void mlp_clear(MlpSums<kRowTiles, kTiles>& sums) {
#pragma unroll
  for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
    for (int t = 0; t < kTiles; ++t) {
#pragma unroll
      for (int i = 0; i < 4; ++i) sums[r][t][i] = 0.0f;
    }
  }
}

// Gradient of 16 kOutputTiles outputs to columns of one source, over the rows of all warps.
template <typename Products, int kOutputTiles>
__device__ void mlp_weight_gradient(const MlpCudaPlan& plan, const typename Products::Element* shared,
                                    const MlpCudaLayer& layer, MlpPlace place, int rows, int output, int column,
                                    int tiles, float* partial, bool first) {
  MlpSums<kOutputTiles, 4> sums;
  mlp_clear<kOutputTiles, 4>(sums);
  for (int warp = 0; warp < plan.warps; ++warp) {
    const auto* region = shared + warp * plan.region;
    Products::template multiply<true, true>(sums, region + layer.value + output, layer.stride,
                                            region + place.value + column, place.stride, rows, tiles);
  }
  const int lane = threadIdx.x % 32;
#pragma unroll
  for (int r = 0; r < kOutputTiles; ++r) {
#pragma unroll
    for (int t = 0; t < 4; ++t) {
      if (t >= tiles) continue;
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        float* to =
            partial + (output + 16 * r + lane / 4 + 8 * half) * layer.partial_stride + column + 8 * t + 2 * (lane % 4);
        float2 pair = first ? make_float2(0.0f, 0.0f) : *reinterpret_cast<const float2*>(to);
        pair.x += sums[r][t][2 * half];
        pair.y += sums[r][t][2 * half + 1];
        *reinterpret_cast<float2*>(to) = pair;
      }
    }
  }
}

// Weights and biases of a layer whose gradients lie where its values were.
template <typename Products>
__device__ void mlp_parameter_gradients(const MlpCudaPlan& plan, const typename Products::Element* shared,
                                        const MlpCudaLayer& layer, int rows, float* partial, bool first) {
  const int warp = threadIdx.x / 32;
  int unit = 0;
  for (int s = 0; s < layer.source_count; ++s) {
    const MlpCudaSource& source = layer.sources[s];
    const MlpPlace place = mlp_place(plan, source.from);
    for (int output = 0; output < layer.padded; output += 32) {
      for (int column = 0; column < source.padded; column += 32, ++unit) {
        if (unit % plan.warps != warp) continue;
        const int tiles = source.padded - column < 32 ? 2 : 4;
        float* to = partial + layer.partial + source.packed;
        if (layer.padded - output >= 32) {
          mlp_weight_gradient<Products, 2>(plan, shared, layer, place, rows, output, column, tiles, to, first);
        } else {
          mlp_weight_gradient<Products, 1>(plan, shared, layer, place, rows, output, column, tiles, to, first);
        }
      }
    }
  }
  for (int column = threadIdx.x; column < layer.padded; column += blockDim.x) {
    float sum = 0.0f;
    for (int w = 0; w < plan.warps; ++w) {
      const auto* gradient = shared + w * plan.region + layer.value + column;
      for (int row = 0; row < rows; ++row) sum += Products::load(gradient + row * layer.stride);
    }
    float* to = partial + layer.partial_bias + column;
    *to = first ? sum : *to + sum;
  }
}

// Gradients of a warp's raw features from those of their encoding, which lie where it was.
template <typename Products, typename Raw>
__device__ void mlp_encode_backward(const MlpCudaInput& input, const typename Products::Element* region, int rows,
                                    int64_t first, int64_t end, const Raw& raw_of, const MlpCudaData& data,
                                    float* results) {
  const int lane = threadIdx.x % 32, features = input.integrated ? input.raw / 2 : input.raw;
  for (int i = lane; i < rows * features; i += 32) {
    const int row = i / features, feature = i - row * features;
    if (first + row >= end) continue;
    mlp_encode_gradient<Products>(input, region + input.value + row * input.stride, raw_of(first + row), feature,
                                  results + mlp_source_row(data, first + row) * input.raw);
  }
}

template <typename Products, int kRowTiles>
__global__ void __launch_bounds__(128, 2)
    mlp_backward_kernel(const MlpCudaPlan plan, const MlpCudaData data, const HashEncoding grid) {
  using Element = typename Products::Element;
  MlpTask task;
  if (!mlp_find_task(data, plan.task_rows, blockIdx.x, task)) return;  // the whole block
  VN_DYN_SHARED(Element, shared);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  constexpr int kRows = 16 * kRowTiles;
  Element* region = shared + warp * plan.region;
  Element* slot = shared + plan.warps * plan.region;
  const unsigned char* packed = data.packed + task.cell * plan.packed_bytes;
  float* partial = data.partials == nullptr ? nullptr : data.partials + blockIdx.x * static_cast<int64_t>(plan.partial);
  if (plan.resident) {
    mlp_copy(reinterpret_cast<unsigned char*>(slot), 0, packed, 0, 1,
             static_cast<int>(sizeof(Element)) * plan.packed_weights);
    __syncthreads();
  }
  for (int64_t tile = task.begin; tile < task.end; tile += plan.warps * kRows) {
    const int64_t first = tile + warp * kRows;
    const auto positions = [&](int64_t row) { return mlp_positions(plan, data, row); };
    const auto directions = [&](int64_t row) { return mlp_directions(plan, data, row); };
    if (plan.positions.hashed) {
      mlp_hash_again<Products, kRows>(plan.positions, data, region, first, task.end);
    } else {
      mlp_encode<Products, kRows>(plan.positions, region, first, task.end, positions);
    }
    mlp_encode<Products, kRows>(plan.directions, region, first, task.end, directions);
    __syncwarp();
    mlp_run<Products, kRowTiles>(plan, region, slot, packed, [](int, int, const MlpSums<kRowTiles, kMlpTiles>&) {});
    // Every layer, then positions and directions, which are layers without a product of their own.
    for (int l = plan.layer_count - 1; l >= kFromDirections; --l) {
      const MlpCudaInput& input = l == kFromDirections ? plan.directions : plan.positions;
      float* results = l == kFromDirections ? data.grad_directions : data.grad_positions;
      const bool wanted = results != nullptr || (l == kFromPositions && data.grad_features != nullptr);
      if (l >= 0 ? !plan.layers[l].live : !wanted || !input.used) continue;
      const MlpPlace place = mlp_place(plan, l);
      const int padded = l >= 0 ? plan.layers[l].padded : input.padded;
      const int activation = l >= 0 ? plan.layers[l].activation : static_cast<int>(Activation::none);
      const int slope = l >= 0 && plan.layers[l].slope >= 0 ? plan.layers[l].slope : place.value;
      for (int chunk = 0; chunk < padded; chunk += kMlpChunk) {
        const int columns = padded - chunk < kMlpChunk ? padded - chunk : kMlpChunk;
        MlpSums<kRowTiles, kMlpTiles> sums;
        mlp_clear<kRowTiles, kMlpTiles>(sums);
        for (int o = 0; o < plan.output_count; ++o) {
          if (plan.outputs[o] != l) continue;
#pragma unroll
          for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
            for (int t = 0; t < kMlpTiles; ++t) {
#pragma unroll
              for (int i = 0; i < 4; ++i) {
                const int64_t row = first + 16 * r + lane / 4 + 8 * (i / 2);
                const int column = chunk + 8 * t + 2 * (lane % 4) + i % 2;
                if (row < task.end && column < plan.layers[l].width) {
                  sums[r][t][i] +=
                      data.grad_out[mlp_source_row(data, row) * plan.out_features + plan.output_columns[o] + column];
                }
              }
            }
          }
        }
        mlp_gather<Products, kRowTiles>(plan, region, slot, packed, l, chunk, columns, sums);
        const auto at = [&](int r, int t, int half) {
          return (16 * r + lane / 4 + 8 * half) * place.stride + chunk + 8 * t + 2 * (lane % 4);
        };
        if (mlp_is_simple(activation)) {
#pragma unroll
          for (int t = 0; t < kMlpTiles; ++t) {
            if (8 * t >= columns) continue;
#pragma unroll
            for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
              for (int half = 0; half < 2; ++half) {
                Element* pair = region + place.value + at(r, t, half);
                const float x = sums[r][t][2 * half], y = sums[r][t][2 * half + 1];
                const bool all = activation == static_cast<int>(Activation::none);
                Products::store_gradient(pair, all || Products::load(pair) > 0.0f ? x : 0.0f,
                                         all || Products::load(pair + 1) > 0.0f ? y : 0.0f);
              }
            }
          }
        } else {
          mlp_for_each_tile(sums, [&](int t, const MlpSums<kRowTiles, 1>& each) {
            if (8 * t >= columns) return;
#pragma unroll
            for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
              for (int half = 0; half < 2; ++half) {
                const int from = slope + at(r, t, half);
                const float x = mlp_times_slope(activation, each[r][0][2 * half], Products::load(region + from));
                const float y =
                    mlp_times_slope(activation, each[r][0][2 * half + 1], Products::load(region + from + 1));
                Products::store_gradient(region + place.value + at(r, t, half), x, y);
              }
            }
          });
        }
      }
      if (l < 0) {
        __syncwarp();
        if (input.hashed) {
          if (data.grad_features != nullptr) {
            mlp_hash_table_backward<Products, kRows>(plan, data, grid, task.cell, region, first, task.end);
          }
          if (data.grad_positions != nullptr) {
            mlp_hash_positions_backward<Products, kRows>(plan, data, grid, task.cell, region, first, task.end);
          }
        } else if (l == kFromPositions) {
          mlp_encode_backward<Products>(input, region, kRows, first, task.end, positions, data, results);
        } else {
          mlp_encode_backward<Products>(input, region, kRows, first, task.end, directions, data, results);
        }
        continue;
      }
      __syncthreads();  // the gradients of all rows are there
      if (partial != nullptr) {
        mlp_parameter_gradients<Products>(plan, shared, plan.layers[l], kRows, partial, tile == task.begin);
      }
      __syncthreads();  // the values of this layer's sources may be replaced
    }
    __syncwarp();
  }
}

}  // namespace

template <typename Products>
void mlp_backward_launch(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid, void* stream) {
  const unsigned blocks = static_cast<unsigned>(plan.tasks), threads = 32 * plan.warps;
  if (plan.row_tiles == 2) {
    mlp_allow_shared(mlp_backward_kernel<Products, 2>);
    VN_LAUNCH((mlp_backward_kernel<Products, 2>), blocks, threads, plan.shared_bytes, stream, plan, data, grid);
  } else {
    mlp_allow_shared(mlp_backward_kernel<Products, 1>);
    VN_LAUNCH((mlp_backward_kernel<Products, 1>), blocks, threads, plan.shared_bytes, stream, plan, data, grid);
  }
}

}  // namespace voronerf
