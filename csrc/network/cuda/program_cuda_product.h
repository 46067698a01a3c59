// Products of a block on CUDA: sums [16 kDown][64] += a [16 kDown][depth] b [64][depth]^T, a thread has 4 kDown of
// them.
//
// Tensor cores: 8 warps, kDown by rows and 8 / kDown by columns; a warp has 16 rows and kDown tiles of 8 columns.
// Values lie as float32 in shared memory and are rounded on their way into a fragment, so that one layout serves all
// precisions; weights are rounded as they come, since four warps read them. Which of 16 steps of the depth is which in
// a fragment is free, if it is the same for both sides: lane 4 g + m takes steps m and m + 4 of what lies by rows and 2
// m, 2 m + 1 of what lies by columns. With strides of 4 more than a multiple of 16 floats, its 32 lanes are then in 32
// different banks. float32: a thread has kDown rows, 16 apart, by four columns.
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

// What a lane has of 16 steps: pairs of a left row, [row g or g + 8][pair][part], and of a right column, [pair][part].
// As fragments of 16 bits:
template <bool kBfloat16>
struct HalfFragments {
  using Element = uint16_t;
  static __device__ __forceinline__ uint32_t pair(const float (&x)[2], float largest) {
    if constexpr (kBfloat16) return pack_halves<true>(x[0], x[1]);
    return pack_halves<false>(cut_off(x[0], largest), cut_off(x[1], largest));
  }
  struct Left {
    uint32_t words[4];
    __device__ __forceinline__ Left(const float (&x)[2][2][2], float largest)
        : words{pair(x[0][0], largest), pair(x[1][0], largest), pair(x[0][1], largest), pair(x[1][1], largest)} {}
  };
  struct Right {
    uint32_t words[2];
    __device__ __forceinline__ Right(const float (&y)[2][2], float largest)
        : words{pair(y[0], largest), pair(y[1], largest)} {}
    // From a strip, where the parts of a pair lie side by side.
    __device__ __forceinline__ Right(const Element* strip, int column, int k, int member) {
      const auto* from = reinterpret_cast<const uint32_t*>(strip + column * kStride + k) + member;
      words[0] = from[0], words[1] = from[4];
    }
  };
  static constexpr int kStride = kProgramDepth + 2 * kProgramSkew;
  static __device__ __forceinline__ void store(Element* strip, int column, int k, float x) {
    const float both[2] = {x, 0.0f};
    strip[column * kStride + k / 8 * 8 + k % 4 * 2 + k / 4 % 2] = static_cast<Element>(pair(both, kLargestHalf));
  }
  static __device__ __forceinline__ void multiply(float (&sums)[4], const Left& left, const Right& right) {
    multiply_halves<kBfloat16>(sums, left.words, right.words);
  }
};

// And as two fragments of tf32.
struct Tf32Fragments {
  using Element = uint32_t;
  static __device__ __forceinline__ uint32_t word(float x) {
    const float rounded = round_to_tf32(x);
    uint32_t bits;
    memcpy(&bits, &rounded, sizeof bits);
    return bits;
  }
  struct Left {
    uint32_t words[2][4];
    __device__ __forceinline__ Left(const float (&x)[2][2][2], float) {
#pragma unroll
      for (int i = 0; i < 8; ++i) words[i / 4][i % 4] = word(x[i % 2][i / 4][i / 2 % 2]);
    }
  };
  struct Right {
    uint32_t words[2][2];
    __device__ __forceinline__ Right(const float (&y)[2][2], float) {
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = word(y[i / 2][i % 2]);
    }
    __device__ __forceinline__ Right(const Element* strip, int column, int k, int member) {
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = strip[column * kStride + k + 4 * i + member];
    }
  };
  static constexpr int kStride = kProgramDepth + kProgramSkew;
  static __device__ __forceinline__ void store(Element* strip, int column, int k, float x) {
    strip[column * kStride + k] = word(x);
  }
  static __device__ __forceinline__ void multiply(float (&sums)[4], const Left& left, const Right& right) {
    multiply_tf32(sums, left.words[0], right.words[0]);
    multiply_tf32(sums, left.words[1], right.words[1]);
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

  // A strip of weights, [64 outputs][32 inputs], rounded; 0 where there are none.
  struct Strip {
    const typename Fragments::Element* data;
  };
  static __device__ __forceinline__ void store(float* strip, int column, int k, float x) {
    Fragments::store(reinterpret_cast<typename Fragments::Element*>(strip), column, k, x);
  }
  static __device__ __forceinline__ Strip strip(const float* data) {
    return {reinterpret_cast<const typename Fragments::Element*>(data)};
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
    float x[2][2][2];
#pragma unroll
    for (int i = 0; i < 8; ++i) {
      x[i / 4][i / 2 % 2][i % 2] = get<kWhole>(a, row + i / 4 * 8, k + i / 2 % 2 * 8, member, i % 2, depth);
    }
    const typename Fragments::Left left(x, a.largest);
#pragma unroll
    for (int t = 0; t < kDown; ++t) {
      Fragments::multiply(sums[t], left, right<kWhole>(b, column + 8 * t, k, member, depth));
    }
  }

  // Part `part` of the pair of this lane in the 8 steps from k on.
  template <bool kWhole, typename Operand>
  static __device__ __forceinline__ float get(const Operand& from, int i, int k, int member, int part, int depth) {
    const int step = k + Operand::kLane * member + Operand::kPair * part;
    return kWhole || step < depth ? from.at(i, step) : 0.0f;
  }
  template <bool kWhole>
  static __device__ __forceinline__ typename Fragments::Right right(const Strip& b, int column, int k, int member,
                                                                    int) {
    return {b.data, column, k, member};
  }
  template <bool kWhole>
  static __device__ __forceinline__ typename Fragments::Right right(const ByColumns& b, int column, int k, int member,
                                                                    int depth) {
    float y[2][2];
#pragma unroll
    for (int i = 0; i < 4; ++i) y[i / 2][i % 2] = get<kWhole>(b, column, k + i / 2 * 8, member, i % 2, depth);
    return {y, b.largest};
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
  static __device__ __forceinline__ void store(float* strip, int column, int k, float x) {
    strip[k * kStripStride + column] = x;
  }
  static __device__ __forceinline__ Strip strip(const float* data) { return {data}; }

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
