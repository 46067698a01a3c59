// The one header that depends on how a .cu file is compiled: by nvcc for a GPU, or by g++ under VN_EMULATE for the
// tests that run the same source on the CPU (tests/cuda_emulation). Launches and shared memory go through macros,
// because g++ does not know CUDA's syntax for them:
//
//   VN_LAUNCH((kernel<64>), grid, block, bytes, stream, arguments...)     launches a kernel and checks for errors
//   VN_SHARED(name, float[8][64]);   VN_DYN_SHARED(float4, name);
//   kernel(const VN_GRID_CONSTANT Struct argument)     functions may take it by reference, without a copy
//
// The functions below wrap instructions for which CUDA C++ has no function.
#pragma once

#include "common/common.h"

#ifdef VN_EMULATE
#include "emulation.h"
#define VN_GRID_CONSTANT
#else
#define VN_GRID_CONSTANT __grid_constant__
#include <cuda_bf16.h>
#include <cuda_fp16.h>

#define VN_LAUNCH(kernel, grid, block, bytes, stream, ...)                          \
  do {                                                                              \
    kernel<<<grid, block, bytes, static_cast<cudaStream_t>(stream)>>>(__VA_ARGS__); \
    VN_CUDA_CHECK(cudaGetLastError());                                              \
  } while (false)
#define VN_SHARED(name, ...)       \
  using name##_type = __VA_ARGS__; \
  __shared__ name##_type name
// All kernels share one symbol, which can have only one type in C++: bytes.
#define VN_DYN_SHARED(T, name)                                        \
  extern __shared__ __align__(128) unsigned char vn_dynamic_shared[]; \
  T* name = reinterpret_cast<T*>(vn_dynamic_shared)
#endif

namespace voronerf {

constexpr unsigned kAllLanes = 0xffffffffu;

// Returns threadIdx.x, read again at each use: otherwise the compiler would keep values derived from it in scarce
// registers. It is unsigned, since a signed number cannot be divided by a shift alone.
__device__ __forceinline__ unsigned thread_again() {
#ifdef VN_EMULATE
  return threadIdx.x;
#else
  unsigned thread;
  asm volatile("mov.u32 %0, %%tid.x;" : "=r"(thread));
  return thread;
#endif
}
// Returns blockDim.x, read again at each use.
__device__ __forceinline__ unsigned threads_again() {
#ifdef VN_EMULATE
  return blockDim.x;
#else
  unsigned threads;
  asm volatile("mov.u32 %0, %%ntid.x;" : "=r"(threads));
  return threads;
#endif
}

// The largest finite float16.
constexpr float kLargestHalf = 65504.0f;

// Rounds two floats to 16 bits each and packs them into a word, the first in the low half. One instruction from sm_80
// on.
template <bool kBfloat16>
__device__ __forceinline__ uint32_t pack_halves(float x, float y) {
#ifdef VN_EMULATE
  return half_bits(x, kBfloat16) | half_bits(y, kBfloat16) << 16;
#else
  uint32_t bits;
  if constexpr (kBfloat16) {
    const __nv_bfloat162 pair = __floats2bfloat162_rn(x, y);
    memcpy(&bits, &pair, sizeof bits);
  } else {
    const __half2 pair = __floats2half2_rn(x, y);
    memcpy(&bits, &pair, sizeof bits);
  }
  return bits;
#endif
}

template <bool kBfloat16>
__device__ __forceinline__ float unpack_half(uint16_t bits) {
#ifdef VN_EMULATE
  return half_value(bits, kBfloat16);
#else
  if constexpr (kBfloat16) {
    return __uint_as_float(static_cast<uint32_t>(bits) << 16);
  } else {
    return __half2float(__ushort_as_half(bits));
  }
#endif
}

// Clamps the two float16 numbers of a word to the largest finite numbers; NaN stays.
__device__ __forceinline__ uint32_t clamp_halves(uint32_t word) {
#ifdef VN_EMULATE
  for (int shift = 0; shift < 32; shift += 16) {
    if ((word >> shift & 0x7fffu) == 0x7c00u) word -= 1u << shift;
  }
  return word;
#else
  __half2 pair;
  memcpy(&pair, &word, sizeof pair);
  const __half2 most = __half2half2(__ushort_as_half(0x7bff));
  pair = __hmax2_nan(__hmin2_nan(pair, most), __hneg2(most));
  memcpy(&word, &pair, sizeof word);
  return word;
#endif
}

// Packs two floats like pack_halves, with negative numbers set to 0; NaN stays. One instruction from sm_80 on.
template <bool kBfloat16>
__device__ __forceinline__ uint32_t pack_relu(float x, float y) {
#if !defined(VN_EMULATE) && __CUDA_ARCH__ >= 800
  uint32_t bits;
  if constexpr (kBfloat16) {
    asm("cvt.rn.relu.bf16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  } else {
    asm("cvt.rn.relu.f16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  }
  return bits;
#else
  return pack_halves<kBfloat16>(x < 0.0f ? 0.0f : x, y < 0.0f ? 0.0f : y);  // comparisons keep NaN
#endif
}

// Returns a mask: all bits of a half are set if its number is above 0 or NaN, else none.
template <bool kBfloat16>
__device__ __forceinline__ uint32_t above_zero_halves(uint32_t word) {
#ifdef VN_EMULATE
  uint32_t mask = 0;
  for (int shift = 0; shift < 32; shift += 16) {
    if (!(half_value(word >> shift & 0xffffu, kBfloat16) <= 0.0f)) mask |= 0xffffu << shift;
  }
  return mask;
#else
  if constexpr (kBfloat16) {
    __nv_bfloat162 pair;
    memcpy(&pair, &word, sizeof pair);
    return __hgtu2_mask(pair, __nv_bfloat162(__ushort_as_bfloat16(0), __ushort_as_bfloat16(0)));
  } else {
    __half2 pair;
    memcpy(&pair, &word, sizeof pair);
    return __hgtu2_mask(pair, __half2half2(__ushort_as_half(0)));
  }
#endif
}

// Adds atomically to one, two or four numbers in global memory, without waiting for the result.
template <int kCount>
__device__ __forceinline__ void add_in_global(float* to, const float* values) {
#ifdef VN_EMULATE
  for (int i = 0; i < kCount; ++i) atomicAdd(to + i, values[i]);
#else
  const size_t at = __cvta_generic_to_global(to);
#if __CUDA_ARCH__ >= 900
  constexpr int kAtOnce = kCount;
#else
  constexpr int kAtOnce = 1;
#endif
  if constexpr (kAtOnce == 4) {
    asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(at), "f"(values[0]), "f"(values[1]),
                 "f"(values[2]), "f"(values[3])
                 : "memory");
  } else if constexpr (kAtOnce == 2) {
    asm volatile("red.global.add.v2.f32 [%0], {%1, %2};" ::"l"(at), "f"(values[0]), "f"(values[1]) : "memory");
  } else {
#pragma unroll
    for (int i = 0; i < kCount; ++i) {
      asm volatile("red.global.add.f32 [%0], %1;" ::"l"(at + 4 * i), "f"(values[i]) : "memory");
    }
  }
#endif
}

// Loads a value through the read-only data cache. Nothing may write the value while this kernel runs.
template <typename T>
__device__ __forceinline__ T load_constant(const T* from) {
#ifdef VN_EMULATE
  return *from;
#else
  return __ldg(from);
#endif
}

// Loads the fragments of a left operand [16][16] of mma.sync: four matrices [8][8] of 16-bit numbers, from rows of
// `stride` words that begin at multiples of 16 bytes. kShared: the rows are in shared memory, and ldmatrix loads them.
template <bool kShared>
__device__ __forceinline__ void load_matrices(uint32_t (&words)[4], const uint32_t* from, int stride, int lane) {
#ifndef VN_EMULATE
  if constexpr (kShared) {
    const auto at = static_cast<uint32_t>(__cvta_generic_to_shared(from + lane % 16 * stride + lane / 16 * 4));
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(words[0]), "=r"(words[1]), "=r"(words[2]), "=r"(words[3])
                 : "r"(at));
  } else
#endif
  {
#pragma unroll
    for (int j = 0; j < 4; ++j) words[j] = from[(lane / 4 + 8 * (j % 2)) * stride + 4 * (j / 2) + lane % 4];
  }
}

// Stores fragments to the places from which load_matrices loads them.
template <bool kShared>
__device__ __forceinline__ void store_matrices(uint32_t* to, const uint32_t (&words)[4], int stride, int lane) {
#if !defined(VN_EMULATE) && __CUDA_ARCH__ >= 900
  if constexpr (kShared) {
    const auto at = static_cast<uint32_t>(__cvta_generic_to_shared(to + lane % 16 * stride + lane / 16 * 4));
    asm volatile("stmatrix.sync.aligned.m8n8.x4.shared.b16 [%0], {%1, %2, %3, %4};" ::"r"(at), "r"(words[0]),
                 "r"(words[1]), "r"(words[2]), "r"(words[3])
                 : "memory");
  } else
#endif
  {
#pragma unroll
    for (int j = 0; j < 4; ++j) to[(lane / 4 + 8 * (j % 2)) * stride + 4 * (j / 2) + lane % 4] = words[j];
  }
}

// Loads a block of 16 rows by 16 columns, transposed so that the rows are the inner dimension of the product. kLeft: as
// the fragments of one left operand [columns][rows]; otherwise as the fragments of two right operands.
template <bool kShared, bool kLeft>
__device__ __forceinline__ void load_transposed(uint32_t (&words)[4], const uint32_t* from, int stride, int lane) {
#ifndef VN_EMULATE
  if constexpr (kShared) {
    const int down = kLeft ? lane / 16 : lane / 8 % 2, across = kLeft ? lane / 8 % 2 : lane / 16;
    const auto at = static_cast<uint32_t>(__cvta_generic_to_shared(from + (lane % 8 + 8 * down) * stride + 4 * across));
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(words[0]), "=r"(words[1]), "=r"(words[2]), "=r"(words[3])
                 : "r"(at));
  } else
#endif
  {
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const int down = kLeft ? j / 2 : j % 2, across = kLeft ? j % 2 : j / 2;
      const uint32_t* at = from + (8 * down + 2 * (lane % 4)) * stride + 4 * across + lane / 8;
      const int shift = lane / 4 % 2 * 16;
      words[j] = (at[0] >> shift & 0xffffu) | (at[stride] >> shift) << 16;
    }
  }
}

// Returns x rounded to TF32 (ten bits of fraction, ties away from zero), as a float32.
__device__ __forceinline__ float round_to_tf32(float x) {
#ifdef VN_EMULATE
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  if ((bits & 0x7f800000u) != 0x7f800000u) bits = (bits + 0x1000u) & 0xffffe000u;
  std::memcpy(&x, &bits, sizeof x);
  return x;
#elif __CUDA_ARCH__ >= 800
  uint32_t bits;
  asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(bits) : "f"(x));
  return __uint_as_float(bits);
#else
  return x;
#endif
}

// Computes d [16][8] += a [16][16] b [16][8] in float32, with fragments as in the PTX manual. Before sm_80 only float16
// is supported, in two instructions.
template <bool kBfloat16>
__device__ __forceinline__ void multiply_halves(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
#ifdef VN_EMULATE
  emulated_multiply(kBfloat16 ? Multiplied::bfloat16 : Multiplied::float16, d, a, b);
#elif __CUDA_ARCH__ >= 800
  if constexpr (kBfloat16) {
    asm volatile(
        "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, "
        "%2, "
        "%3};"
        : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
  } else {
    asm volatile(
        "mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
        "%3};"
        : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
  }
#else
  if constexpr (!kBfloat16) {
    for (int half = 0; half < 2; ++half) {
      asm volatile(
          "mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
          : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
          : "r"(a[2 * half]), "r"(a[2 * half + 1]), "r"(b[half]));
    }
  } else {
    __trap();  // the launcher multiplies in float32 there
  }
#endif
}

// Computes d [16][8] += a [16][8] b [8][8] with operands rounded to TF32, from sm_80 on.
__device__ __forceinline__ void multiply_tf32(float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
#ifdef VN_EMULATE
  emulated_multiply(Multiplied::tf32, d, a, b);
#elif __CUDA_ARCH__ >= 800
  asm volatile(
      "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
      "%3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
#else
  __trap();  // the launcher multiplies in float32 there
#endif
}

}  // namespace voronerf
