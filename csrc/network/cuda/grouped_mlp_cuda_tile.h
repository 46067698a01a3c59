// What the forward and the backward kernel of grouped_mlp share: products of a warp's tiles, and the rows of a task.
#pragma once

#include "common/cuda_wrappers.h"
#include "encoding/encode_math.h"
#include "network/cuda/grouped_mlp_cuda.h"

namespace voronerf {

constexpr int kMlpTiles = kMlpChunk / 8;  // 8-column tiles that a warp has in registers

// Lets a kernel have all the shared memory that a block may ask for. Always the same, since what one host thread sets
// must do for the launch of another.
template <typename Kernel>
void mlp_allow_shared(Kernel* kernel) {
  VN_CUDA_CHECK(
      cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, mlp_cuda_device().shared_bytes));
}

// A warp's sums: [16 rows][8 columns] each, in the layout of mma's accumulators. Lane l has rows l / 4 and l / 4 + 8,
// columns 2 (l % 4) and the next.
template <int kRowTiles, int kTiles>
using MlpSums = float[kRowTiles][kTiles][4];

// An operand in shared memory: element (i, k) is at[i * stride + k], or transposed at[k * stride + i].
//
// 16-bit operands.
template <bool kBfloat16>
struct HalfProducts {
  using Element = uint16_t;
  static constexpr int kSkew = 8;
  static constexpr bool kRounded = true;  // operands have far fewer bits than float32

  static __device__ void store(Element* to, float x, float y) {
    *reinterpret_cast<uint32_t*>(to) = pack_halves<kBfloat16>(x, y);
  }
  static __device__ void store_gradient(Element* to, float x, float y) {
    *reinterpret_cast<uint32_t*>(to) = pack_halves<kBfloat16, false>(x, y);
  }
  static __device__ void store_one(Element* to, float x) {
    *to = static_cast<Element>(pack_halves<kBfloat16>(x, 0.0f));
  }
  static __device__ float load(const Element* from) { return unpack_half<kBfloat16>(*from); }

  // sums += a b^T with a [16 kRowTiles][depth], b [8 tiles][depth]; depth a multiple of 16, tiles of 2.
  template <bool kTransposedA, bool kTransposedB, int kRowTiles, int kTiles>
  static __device__ void multiply(MlpSums<kRowTiles, kTiles>& sums, const Element* a, int a_stride, const Element* b,
                                  int b_stride, int depth, int tiles) {
    const int lane = threadIdx.x % 32, low = lane % 8, middle = lane / 8 % 2, high = lane / 16;
    for (int k = 0; k < depth; k += 16) {
      uint32_t left[kRowTiles][4];
#pragma unroll
      for (int r = 0; r < kRowTiles; ++r) {
        const int row = 16 * r + low + 8 * middle, column = k + 8 * high;
        if constexpr (kTransposedA) {
          load_matrices<true>(left[r], a + (k + low + 8 * high) * a_stride + 16 * r + 8 * middle);
        } else {
          load_matrices<false>(left[r], a + row * a_stride + column);
        }
      }
#pragma unroll
      for (int tile = 0; tile < kTiles; tile += 2) {
        if (tile < tiles) {
          uint32_t right[4];
          if constexpr (kTransposedB) {
            load_matrices<true>(right, b + (k + low + 8 * middle) * b_stride + 8 * tile + 8 * high);
          } else {
            load_matrices<false>(right, b + (8 * tile + low + 8 * high) * b_stride + k + 8 * middle);
          }
          const uint32_t first[2] = {right[0], right[1]}, second[2] = {right[2], right[3]};
#pragma unroll
          for (int r = 0; r < kRowTiles; ++r) {
            multiply_halves<kBfloat16>(sums[r][tile], left[r], first);
            multiply_halves<kBfloat16>(sums[r][tile + 1], left[r], second);
          }
        }
      }
    }
  }
};

// float32 operands: rounded to tf32 on tensor cores, or exactly, on the others.
template <bool kTf32>
struct FloatProducts {
  using Element = float;
  static constexpr int kSkew = 4;
  static constexpr bool kRounded = kTf32;

  static __device__ void store(Element* to, float x, float y) {
    *reinterpret_cast<float2*>(to) = kTf32 ? make_float2(round_to_tf32(x), round_to_tf32(y)) : make_float2(x, y);
  }
  static __device__ void store_gradient(Element* to, float x, float y) { store(to, x, y); }
  static __device__ void store_one(Element* to, float x) { *to = kTf32 ? round_to_tf32(x) : x; }
  static __device__ float load(const Element* from) { return *from; }

  template <bool kTransposed>
  static __device__ float at(const Element* from, int stride, int i, int k) {
    return kTransposed ? from[k * stride + i] : from[i * stride + k];
  }
  template <bool kTransposed>
  static __device__ uint32_t bits(const Element* from, int stride, int i, int k) {
    const float x = at<kTransposed>(from, stride, i, k);
    uint32_t word;
    memcpy(&word, &x, sizeof word);
    return word;
  }

  template <bool kTransposedA, bool kTransposedB, int kRowTiles, int kTiles>
  static __device__ void multiply(MlpSums<kRowTiles, kTiles>& sums, const Element* a, int a_stride, const Element* b,
                                  int b_stride, int depth, int tiles) {
    const int lane = threadIdx.x % 32, group = lane / 4, member = lane % 4;
    if constexpr (kTf32) {
      for (int k = 0; k < depth; k += 8) {
        uint32_t left[kRowTiles][4];
#pragma unroll
        for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
          for (int i = 0; i < 4; ++i) {
            left[r][i] = bits<kTransposedA>(a, a_stride, 16 * r + group + 8 * (i % 2), k + member + 4 * (i / 2));
          }
        }
#pragma unroll
        for (int tile = 0; tile < kTiles; ++tile) {
          if (tile < tiles) {
            const uint32_t right[2] = {bits<kTransposedB>(b, b_stride, 8 * tile + group, k + member),
                                       bits<kTransposedB>(b, b_stride, 8 * tile + group, k + member + 4)};
#pragma unroll
            for (int r = 0; r < kRowTiles; ++r) multiply_tf32(sums[r][tile], left[r], right);
          }
        }
      }
    } else {
      // Four steps of k at a time: untransposed operands come as vectors.
      for (int k = 0; k < depth; k += 4) {
        float left[2 * kRowTiles][4];
#pragma unroll
        for (int r = 0; r < 2 * kRowTiles; ++r) load_four<kTransposedA>(left[r], a, a_stride, group + 8 * r, k);
#pragma unroll
        for (int tile = 0; tile < kTiles; ++tile) {
          if (tile < tiles) {
#pragma unroll
            for (int part = 0; part < 2; ++part) {
              float right[4];
              load_four<kTransposedB>(right, b, b_stride, 8 * tile + 2 * member + part, k);
#pragma unroll
              for (int r = 0; r < 2 * kRowTiles; ++r) {
                float sum = sums[r / 2][tile][2 * (r % 2) + part];
#pragma unroll
                for (int step = 0; step < 4; ++step) sum = fmaf(left[r][step], right[step], sum);
                sums[r / 2][tile][2 * (r % 2) + part] = sum;
              }
            }
          }
        }
      }
    }
  }

  template <bool kTransposed>
  static __device__ void load_four(float (&to)[4], const Element* from, int stride, int i, int k) {
    if constexpr (kTransposed) {
#pragma unroll
      for (int step = 0; step < 4; ++step) to[step] = from[(k + step) * stride + i];
    } else {
      const float4 four = *reinterpret_cast<const float4*>(from + i * stride + k);
      to[0] = four.x, to[1] = four.y, to[2] = four.z, to[3] = four.w;
    }
  }
};

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

// Raw features of a row.
__device__ inline const float* mlp_positions(const MlpCudaPlan& plan, const MlpCudaData& data, int64_t row) {
  return data.positions + mlp_source_row(data, row) * plan.positions.raw;
}
__device__ inline const float* mlp_directions(const MlpCudaPlan& plan, const MlpCudaData& data, int64_t row) {
  const int64_t source = mlp_source_row(data, row);
  return data.directions +
         (data.direction_index == nullptr ? source : data.direction_index[source]) * plan.directions.raw;
}

// One column of an encoding.
__device__ inline float mlp_encoded(const MlpCudaInput& input, const float* raw, int column) {
  if (column >= input.width) return 0.0f;
  if (input.octaves < 0) return raw[column];
  const int features = input.integrated ? input.raw / 2 : input.raw;
  if (!input.integrated) {
    if (column < features) return raw[column];
    column -= features;
  }
  const int part = column / features, feature = column - part * features;
  const float scale = octave_scale(part / 2);
  const float value = sine_of_octave(raw[feature] * scale, part % 2 == 0 ? 0.0f : 0.5f);
  return input.integrated ? value * octave_blur(scale, raw[features + feature]) : value;
}

// x / 2 pi in two parts, exact to float32's square, so that a multiple of it by a power of 2 has a fraction.
struct MlpTurns {
  float high, low;
};
__device__ inline MlpTurns mlp_turns(float x) {
  constexpr float kHigh = 0.159154937f, kLow = 6.42063833e-9f;
  const float high = x * kHigh;
  return {high, fmaf(x, kLow, fmaf(x, kHigh, -high))};
}

// The encoding of three coordinates, a row a lane (with 16 rows, the octaves between two lanes), for rounded operands:
// an angle is reduced once for its sine and cosine, and neither is computed more exactly than is kept. By counting, a
// tenth of the instructions of going column by column, which were more than those of four layers of width 64.
template <typename Products>
__device__ void mlp_encode_three(const MlpCudaInput& input, typename Products::Element* to, const float* raw, int part,
                                 int parts) {
  const int before = input.integrated ? 0 : 3;
  MlpTurns turns[3];
#pragma unroll
  for (int feature = 0; feature < 3; ++feature) turns[feature] = mlp_turns(raw[feature]);
  for (int octave = part; octave < input.octaves; octave += parts) {
    const float scale = octave_scale(octave);
    float sines[3], cosines[3];
#pragma unroll
    for (int feature = 0; feature < 3; ++feature) {
      const float whole = turns[feature].high * scale;
      const float nearest = (whole + 12582912.0f) - 12582912.0f;
      const float angle = 6.28318531f * fmaf(turns[feature].low, scale, whole - nearest);
      const float blur = input.integrated ? octave_blur(scale, raw[3 + feature]) : 1.0f;
      sines[feature] = blur * fast_sine(angle);
      cosines[feature] = blur * fast_cosine(angle);
    }
    auto* columns = to + before + 6 * octave;
    if (input.integrated) {
      Products::store(columns, sines[0], sines[1]);
      Products::store(columns + 2, sines[2], cosines[0]);
      Products::store(columns + 4, cosines[1], cosines[2]);
    } else {
      // Pairs begin at even columns; the odd ends of an octave are stored alone.
      Products::store_one(columns, sines[0]);
      Products::store(columns + 1, sines[1], sines[2]);
      Products::store(columns + 3, cosines[0], cosines[1]);
      Products::store_one(columns + 5, cosines[2]);
    }
  }
  if (part > 0) return;
  if (!input.integrated) {
    Products::store(to, raw[0], raw[1]);
    Products::store_one(to + 2, raw[2]);
  }
  for (int column = input.width; column < input.padded; ++column) Products::store_one(to + column, 0.0f);
}

// Whether mlp_encode_three() holds for a row: angles whose turns a float32 counts.
__device__ inline bool mlp_are_near(const MlpCudaInput& input, const float* raw) {
  const float scale = octave_scale(input.octaves);
  return fabsf(raw[0]) * scale <= kLargestDeviceAngle && fabsf(raw[1]) * scale <= kLargestDeviceAngle &&
         fabsf(raw[2]) * scale <= kLargestDeviceAngle;
}

// Encodes a warp's rows into its region; rows past the end are zero.
template <typename Products, int kRows, typename Raw>
__device__ void mlp_encode(const MlpCudaInput& input, typename Products::Element* region, int64_t first, int64_t end,
                           const Raw& raw_of) {
  if (!input.used) return;
  const int lane = threadIdx.x % 32, pairs = input.padded / 2;
  bool by_columns = true;
  if constexpr (Products::kRounded) {
    if (input.octaves > 0 && input.raw == (input.integrated ? 6 : 3)) {
      const int row = lane % kRows;
      const bool there = first + row < end;
      const float* raw = there ? raw_of(first + row) : nullptr;
      const bool near = !there || mlp_are_near(input, raw);
      by_columns = __ballot_sync(kAllLanes, near) != kAllLanes;
      auto* to = region + input.value + row * input.stride;
      if (there && near) mlp_encode_three<Products>(input, to, raw, lane / kRows, 32 / kRows);
      if (!there) {
        for (int column = 2 * (lane / kRows); column < input.padded; column += 64 / kRows) {
          Products::store(to + column, 0.0f, 0.0f);
        }
      }
      if (by_columns) __syncwarp();
    }
  }
  if (!by_columns) return;
  for (int i = lane; i < kRows * pairs; i += 32) {
    const int row = i / pairs, column = 2 * (i - row * pairs);
    float x = 0.0f, y = 0.0f;
    if (first + row < end) {
      const float* raw = raw_of(first + row);
      x = mlp_encoded(input, raw, column);
      y = mlp_encoded(input, raw, column + 1);
    }
    Products::store(region + input.value + row * input.stride + column, x, y);
  }
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
__device__ inline bool mlp_is_simple(int activation) {
  return activation <= static_cast<int>(Activation::relu);
}
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

// Gradient of one raw feature of a row, and of its variance, from the row's encoding.
template <typename Products>
__device__ void mlp_encode_gradient(const MlpCudaInput& input, const typename Products::Element* gradient,
                                    const float* raw, int feature, float* result) {
  const int features = input.integrated ? input.raw / 2 : input.raw;
  gradient += feature;
  float sum = 0.0f, of_variance = 0.0f;
  if (!input.integrated) {
    sum = Products::load(gradient);
    gradient += features;
  }
  for (int octave = 0; octave < input.octaves; ++octave, gradient += 2 * features) {
    const float scale = octave_scale(octave), angle = raw[feature] * scale;
    const float sine = sine_of_octave(angle, 0.0f), cosine = sine_of_octave(angle, 0.5f);
    const float of_sine = Products::load(gradient), of_cosine = Products::load(gradient + features);
    const float blur = input.integrated ? octave_blur(scale, raw[features + feature]) : 1.0f;
    sum += scale * blur * (of_sine * cosine - of_cosine * sine);
    of_variance += -0.5f * scale * scale * blur * (of_sine * sine + of_cosine * cosine);
  }
  result[feature] = sum;
  if (input.integrated) result[features + feature] = of_variance;
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
