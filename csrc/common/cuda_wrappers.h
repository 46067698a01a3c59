// The one header that knows how a .cu file is compiled: by nvcc for a GPU, or by g++ under VN_EMULATE for the tests
// that run the same source on the CPU (tests/cuda_emulation). Launches and shared memory go through macros, because
// CUDA's own words for them mean nothing, or something else, to g++:
//
//   VN_LAUNCH((kernel<64>), grid, block, bytes, stream, arguments...)     checked
//   VN_SHARED(name, float[8][64]);   VN_DYN_SHARED(float4, name);
//   kernel(const VN_GRID_CONSTANT Struct argument)     which functions may have by reference without a copy
//
// Below them are the instructions that CUDA C++ has no function for.
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
// One symbol for all kernels, hence bytes: C++ allows it no second type.
#define VN_DYN_SHARED(T, name)                                        \
  extern __shared__ __align__(128) unsigned char vn_dynamic_shared[]; \
  T* name = reinterpret_cast<T*>(vn_dynamic_shared)
#endif

namespace voronerf {

constexpr unsigned kAllLanes = 0xffffffffu;

// threadIdx.x, read where it is used: the compiler would otherwise keep values derived from it in scarce registers.
__device__ __forceinline__ int thread_again() {
#ifdef VN_EMULATE
  return static_cast<int>(threadIdx.x);
#else
  int thread;
  asm volatile("mov.u32 %0, %%tid.x;" : "=r"(thread));
  return thread;
#endif
}

// Largest value of float16: larger values would become infinite, and infinities in a network soon become NaN.
constexpr float kLargestHalf = 65504.0f;

// Two floats, negative ones as zero if kRelu says so, rounded to 16 bits each, the first in the low half. Gradients are
// not to be saturated: whoever scales a loss looks for the infinite ones. From sm_80 on all of it is one instruction;
// NaN stays NaN.
template <bool kBfloat16, bool kSaturated = true, bool kRelu = false>
__device__ __forceinline__ uint32_t pack_halves(float x, float y) {
#if !defined(VN_EMULATE) && __CUDA_ARCH__ >= 800
  uint32_t bits;
  if constexpr (kBfloat16 && kRelu) {
    asm("cvt.rn.relu.bf16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  } else if constexpr (kBfloat16) {
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  } else if constexpr (kRelu && kSaturated) {
    asm("cvt.rn.relu.satfinite.f16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  } else if constexpr (kRelu) {
    asm("cvt.rn.relu.f16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  } else if constexpr (kSaturated) {
    asm("cvt.rn.satfinite.f16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  } else {
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(y), "f"(x));
  }
  return bits;
#else
  // Comparisons keep NaN.
  if constexpr (kRelu) {
    x = x < 0.0f ? 0.0f : x;
    y = y < 0.0f ? 0.0f : y;
  }
  if constexpr (!kBfloat16 && kSaturated) {
    x = x > kLargestHalf ? kLargestHalf : x < -kLargestHalf ? -kLargestHalf : x;
    y = y > kLargestHalf ? kLargestHalf : y < -kLargestHalf ? -kLargestHalf : y;
  }
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

// x with the ten bits of fraction that tensor cores multiply, ties away from zero; as float32.
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

// Sine and cosine of -pi..pi to about 5e-7, by the device's own unit.
__device__ __forceinline__ float fast_sine(float x) {
#ifdef VN_EMULATE
  return sinf(x);
#else
  return __sinf(x);
#endif
}
__device__ __forceinline__ float fast_cosine(float x) {
#ifdef VN_EMULATE
  return cosf(x);
#else
  return __cosf(x);
#endif
}

// Loads four 8 x 8 matrices of 16-bit elements from shared memory: lane l gives the address of row l % 8 of matrix l /
// 8 (16 bytes, aligned) and gets elements 2 (l % 4) and the next of row l / 4 of each; transposed, of column l / 4.
template <bool kTransposed>
__device__ __forceinline__ void load_matrices(uint32_t (&out)[4], const void* row) {
#ifdef VN_EMULATE
  emulated_ldmatrix(out, row, kTransposed);
#else
  const uint32_t address = static_cast<uint32_t>(__cvta_generic_to_shared(row));
  if constexpr (kTransposed) {
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(out[0]), "=r"(out[1]), "=r"(out[2]), "=r"(out[3])
                 : "r"(address)
                 : "memory");
  } else {
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(out[0]), "=r"(out[1]), "=r"(out[2]), "=r"(out[3])
                 : "r"(address)
                 : "memory");
  }
#endif
}

// Copies 16 bytes, aligned, from global to shared memory, or clears them there; complete, for this thread, once
// copy_wait() has waited for its group, and for others after a barrier. Before sm_80 it is complete at once.
__device__ __forceinline__ void copy_async(void* to, const void* from, bool valid) {
#ifdef VN_EMULATE
  emulated_copy_async(to, from, valid);
#elif __CUDA_ARCH__ >= 800
  const uint32_t address = static_cast<uint32_t>(__cvta_generic_to_shared(to));
  const int bytes = valid ? 16 : 0;
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(address), "l"(from), "r"(bytes) : "memory");
#else
  *static_cast<float4*>(to) = valid ? *static_cast<const float4*>(from) : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
#endif
}

// Closes a group of copies.
__device__ __forceinline__ void copy_commit() {
#ifdef VN_EMULATE
  emulated_copy_commit();
#elif __CUDA_ARCH__ >= 800
  asm volatile("cp.async.commit_group;" ::: "memory");
#endif
}

// Waits until at most kPending groups, the last ones, are under way.
template <int kPending>
__device__ __forceinline__ void copy_wait() {
#ifdef VN_EMULATE
  emulated_copy_wait(kPending);
#elif __CUDA_ARCH__ >= 800
  asm volatile("cp.async.wait_group %0;" ::"n"(kPending) : "memory");
#endif
}

// d [16][8] += a [16][16] b [16][8] in float32; fragments as in the PTX manual. Before sm_80 float16 alone, in two
// steps.
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

// d [16][8] += a [16][8] b [8][8], operands rounded to tf32. From sm_80 on.
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
