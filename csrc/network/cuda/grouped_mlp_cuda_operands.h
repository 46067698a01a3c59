// Operands and products of a warp's tiles: 16 bits, tf32 or float32, by tensor cores or exactly.
#pragma once

#include "common/cuda_wrappers.h"
#include "network/grouped_mlp.h"

namespace voronerf {

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

  // sums += a b^T with a [16 kRowTiles][depth], b [8 tiles][depth]; depth a multiple of 16, tiles of 2. How many tiles
  // there are is decided before the loop: a branch for each would keep loads from running ahead of products.
  template <bool kTransposedA, bool kTransposedB, int kRowTiles, int kTiles>
  static __device__ void multiply(MlpSums<kRowTiles, kTiles>& sums, const Element* a, int a_stride, const Element* b,
                                  int b_stride, int depth, int tiles) {
    if constexpr (kTiles == 8) {
      if (tiles == 8) {
        return multiply_tiles<kTransposedA, kTransposedB, 0, 8>(sums, a, a_stride, b, b_stride, depth);
      }
      if (tiles == 6) multiply_tiles<kTransposedA, kTransposedB, 4, 2>(sums, a, a_stride, b, b_stride, depth);
    }
    if (tiles >= 4) {
      multiply_tiles<kTransposedA, kTransposedB, 0, 4>(sums, a, a_stride, b, b_stride, depth);
    } else if (tiles > 0) {
      multiply_tiles<kTransposedA, kTransposedB, 0, 2>(sums, a, a_stride, b, b_stride, depth);
    }
  }

  template <bool kTransposedA, bool kTransposedB, int kFirst, int kCount, int kRowTiles, int kTiles>
  static __device__ void multiply_tiles(MlpSums<kRowTiles, kTiles>& sums, const Element* a, int a_stride,
                                        const Element* b, int b_stride, int depth) {
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
      for (int tile = kFirst; tile < kFirst + kCount; tile += 2) {
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

// body(products) for what a precision multiplies.
template <typename Body>
void mlp_with_products(MlpPrecision precision, const Body& body) {
  switch (precision) {
    case MlpPrecision::bfloat16:
      return body(HalfProducts<true>{});
    case MlpPrecision::float16:
      return body(HalfProducts<false>{});
    case MlpPrecision::tf32:
      return body(FloatProducts<true>{});
    case MlpPrecision::float32:
      return body(FloatProducts<false>{});
  }
}

}  // namespace voronerf
