// Products of a block on CUDA: sums [16 kDown][64] += a [16 kDown][depth] b [64][depth]^T, a thread has 4 kDown of
// them.
//
// Tensor cores: 8 warps, kDown by rows and 8 / kDown by columns; a warp has 16 rows and kDown tiles of 8 columns. What
// is multiplied lies as float32 in shared memory and is rounded on its way into a fragment, so that one layout serves
// all precisions. Which of 16 steps of the depth is which in a fragment is free, if it is the same for both sides:
// lane 4 g + m takes steps m and m + 4 of what lies by rows and 2 m, 2 m + 1 of what lies by columns. With strides of
// 4 more than a multiple of 16 floats, its 32 lanes are then in 32 different banks. float32: a thread has kDown rows,
// 16 apart, by four columns.
#pragma once

#include "common/cuda_wrappers.h"
#include "common/index_maps.h"

namespace voronerf {

constexpr int kProgramThreads = 256;
constexpr int kProgramWide = 64;   // columns of a block
constexpr int kProgramDepth = 32;  // of a strip of weights
constexpr int kProgramSkew = 4;    // floats that rows in shared memory are longer than a multiple of 16
constexpr int kProgramStrip = kProgramWide * (kProgramDepth + kProgramSkew);

// Entry (i, k) of an operand that lies by rows, and by columns, of which there are `count`. Numbers beyond `largest`
// are cut off where they are rounded to float16.
struct ByRows {
  const float* data;
  int stride;
  float largest;
  static constexpr int kLane = 1, kPair = 4;
  __device__ float at(int i, int k) const { return data[i * stride + k]; }
};
struct ByColumns {
  const float* data;
  int stride;
  float largest;
  int count;
  static constexpr int kLane = 2, kPair = 1;
  __device__ float at(int i, int k) const { return i < count ? data[k * stride + i] : 0.0f; }
  __device__ float4 four(int i, int k) const { return make_float4(at(i, k), at(i + 1, k), at(i + 2, k), at(i + 3, k)); }
};

__device__ __forceinline__ float cut_off(float x, float largest) {  // NaN stays NaN
  return x > largest ? largest : x < -largest ? -largest : x;
}

// Pairs of steps as a fragment of 16 bits.
template <bool kBfloat16>
struct HalfFragments {
  static __device__ __forceinline__ uint32_t pair(const float (&x)[2], float largest) {
    if constexpr (kBfloat16) return pack_halves<true>(x[0], x[1]);
    return pack_halves<false>(cut_off(x[0], largest), cut_off(x[1], largest));
  }
  // Rows g and g + 8 by four pairs of steps; a column by two.
  template <typename A>
  struct Left {
    uint32_t words[4];
    __device__ __forceinline__ Left(const float (&x)[2][2][2], const A& a)
        : words{pair(x[0][0], a.largest), pair(x[1][0], a.largest), pair(x[0][1], a.largest),
                pair(x[1][1], a.largest)} {}
  };
  template <typename A, typename B>
  static __device__ __forceinline__ void multiply(float (&sums)[4], const Left<A>& left, const float (&y)[2][2],
                                                  const B& b) {
    const uint32_t right[2] = {pair(y[0], b.largest), pair(y[1], b.largest)};
    multiply_halves<kBfloat16>(sums, left.words, right);
  }
};

// The same as two fragments of tf32.
struct Tf32Fragments {
  static __device__ __forceinline__ uint32_t word(float x) {
    const float rounded = round_to_tf32(x);
    uint32_t bits;
    memcpy(&bits, &rounded, sizeof bits);
    return bits;
  }
  template <typename A>
  struct Left {
    uint32_t words[2][4];
    __device__ __forceinline__ Left(const float (&x)[2][2][2], const A&) {
#pragma unroll
      for (int p = 0; p < 2; ++p) {
#pragma unroll
        for (int i = 0; i < 4; ++i) words[p][i] = word(x[i % 2][p][i / 2]);
      }
    }
  };
  template <typename A, typename B>
  static __device__ __forceinline__ void multiply(float (&sums)[4], const Left<A>& left, const float (&y)[2][2],
                                                  const B&) {
#pragma unroll
    for (int p = 0; p < 2; ++p) {
      const uint32_t right[2] = {word(y[p][0]), word(y[p][1])};
      multiply_tf32(sums, left.words[p], right);
    }
  }
};

template <typename Fragments, int kDown>
struct TensorProducts {
  static constexpr int kSums = 4 * kDown;
  using Sums = float[kDown][4];

  // Where sum i is in the block.
  static __device__ __forceinline__ MapPlace place(int i) {
    const int thread = thread_again(), warp = thread / 32;
    const MapPlace own = accumulator_place(static_cast<unsigned>(thread) % 32, i % 4);
    return {16 * (warp % kDown) + own.row, 8 * (warp / kDown * kDown + i / 4) + own.column};
  }
  static __device__ __forceinline__ float& sum(Sums& sums, int i) { return sums[i / 4][i % 4]; }

  // A strip of weights, [64 outputs][32 inputs].
  static __device__ __forceinline__ int strip_place(int column, int k) {
    return column * (kProgramDepth + kProgramSkew) + k;
  }
  static __device__ __forceinline__ ByRows strip(const float* data, float largest) {
    return {data, kProgramDepth + kProgramSkew, largest};
  }

  // Warps without columns have nothing to do.
  template <typename A, typename B>
  static __device__ __forceinline__ void multiply(Sums& sums, const A& a, const B& b, int depth, int columns) {
    if (thread_again() / 32 / kDown * kDown * 8 >= columns) return;
    int k = 0;
#pragma unroll 1
    for (; k + 16 <= depth; k += 16) block<true>(sums, a, b, k, depth);
    if (k < depth) block<false>(sums, a, b, k, depth);
  }

 private:
  template <bool kWhole, typename A, typename B>
  static __device__ __forceinline__ void block(Sums& sums, const A& a, const B& b, int k, int depth) {
    const int thread = thread_again(), warp = thread / 32, group = thread % 32 / 4, member = thread % 4;
    const int row = 16 * (warp % kDown) + group, column = 8 * (warp / kDown * kDown) + group;
    // Step `part` of pair p of this lane.
    const auto get = [&](const auto& from, int i, int p, int part) {
      using From = std::decay_t<decltype(from)>;
      const int step = k + 8 * p + From::kLane * member + From::kPair * part;
      return kWhole || step < depth ? from.at(i, step) : 0.0f;
    };
    float x[2][2][2];
#pragma unroll
    for (int i = 0; i < 8; ++i) x[i / 4][i / 2 % 2][i % 2] = get(a, row + i / 4 * 8, i / 2 % 2, i % 2);
    const typename Fragments::template Left<A> left(x, a);
#pragma unroll
    for (int t = 0; t < kDown; ++t) {
      float y[2][2];
#pragma unroll
      for (int i = 0; i < 4; ++i) y[i / 2][i % 2] = get(b, column + 8 * t, i / 2, i % 2);
      Fragments::multiply(sums[t], left, y, b);
    }
  }
};

template <int kDown>
struct FloatProducts {
  static constexpr int kSums = 4 * kDown;
  static constexpr int kStripStride = kProgramWide + kProgramSkew;
  using Sums = float[kDown][4];

  static __device__ __forceinline__ MapPlace place(int i) {
    const int thread = thread_again();
    return {thread / 16 + i / 4 * 16, 4 * (thread % 16) + i % 4};
  }
  static __device__ __forceinline__ float& sum(Sums& sums, int i) { return sums[i / 4][i % 4]; }

  // A strip of weights, [32 inputs][64 outputs].
  struct Strip {
    const float* data;
    __device__ float4 four(int i, int k) const { return *reinterpret_cast<const float4*>(data + k * kStripStride + i); }
  };
  static __device__ __forceinline__ int strip_place(int column, int k) { return k * kStripStride + column; }
  static __device__ __forceinline__ Strip strip(const float* data, float) { return {data}; }

  template <typename A, typename B>
  static __device__ __forceinline__ void multiply(Sums& sums, const A& a, const B& b, int depth, int columns) {
    const MapPlace first = place(0);
    if (first.column >= columns) return;
#pragma unroll 4
    for (int k = 0; k < depth; ++k) {
      const float4 y = b.four(first.column, k);
#pragma unroll
      for (int r = 0; r < kDown; ++r) {
        const float x = a.at(first.row + 16 * r, k);
        sums[r][0] = fmaf(x, y.x, sums[r][0]);
        sums[r][1] = fmaf(x, y.y, sums[r][1]);
        sums[r][2] = fmaf(x, y.z, sums[r][2]);
        sums[r][3] = fmaf(x, y.w, sums[r][3]);
      }
    }
  }
};

}  // namespace voronerf
