// Products of a group of four warps, wgmma: 64 rows at once, the left operand in registers, the right one in shared
// memory, which is read once for all of them. For code that is compiled for sm_90a, which alone has the instruction;
// its twin runs in the tests like those of cuda_wrappers.h. From the PTX manual, "Asynchronous Warpgroup Level
// Matrix-Multiply-Accumulate Instructions":
//
//   - Of rows 16 w to 16 w + 15, warp w of a group has what mma.m16n8k16 gives it, of the left operand and of the sums,
//     tiles of 8 columns side by side ("Register Fragments", m64nNk16).
//   - A product is under way until it is waited for: until then neither its sums nor its left operand may be read or
//     written, nor what the right one is in shared memory ("wgmma.wait_group").
//   - Registers that were read or written since must pass a fence before a product takes them ("wgmma.fence").
//   - The compiler takes sums to be there when a product has begun, and may do with them before the wait what comes
//     behind it, unless they are settled in between (group_settle).
//   - Products read shared memory by another way than threads write it, cp.async included: who wrote says so before
//     the barrier that the others wait at ("Async Proxy").
#pragma once

#include "common/cuda_wrappers.h"
#ifdef VN_EMULATE
#include "emulation_groups.h"
#endif

namespace voronerf {

constexpr int kGroupThreads = 128;

// What names the right operand of a product, n x k with k along a row, in core matrices of 8 x 8, rows of 16 bytes one
// behind the other ("Matrix Descriptor Format", without swizzling). address: of the first, in the window of shared
// memory; leading: bytes to the one for the next 8 columns of k; stride: to the one for the next 8 of n; multiples of
// 16 all. 14 bits each, of 16 bytes.
VN_HD constexpr uint64_t group_descriptor(uint32_t address, uint32_t leading, uint32_t stride) {
  return static_cast<uint64_t>((address & 0x3ffffu) >> 4) | static_cast<uint64_t>((leading & 0x3ffffu) >> 4) << 16 |
         static_cast<uint64_t>((stride & 0x3ffffu) >> 4) << 32;
}

__device__ __forceinline__ uint64_t group_matrix(const void* shared, uint32_t leading, uint32_t stride) {
#ifdef VN_EMULATE
  return group_descriptor(emulated_shared_address(shared), leading, stride);
#else
  return group_descriptor(static_cast<uint32_t>(__cvta_generic_to_shared(shared)), leading, stride);
#endif
}

// What this thread wrote to shared memory, products may read after the next barrier.
__device__ __forceinline__ void group_publish() {
#ifdef VN_EMULATE
  emulated_publish();
#elif defined(__CUDA_ARCH_FEAT_SM90_ALL)
  asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
#else
  __trap();
#endif
}

// Registers that the next fence is for, or sums that have been waited for: the compiler may not move across this what
// they are made of, nor what is made of them.
template <int kRows, int kColumns>
__device__ __forceinline__ void group_settle(float (&sums)[kRows][kColumns]) {
#ifdef VN_EMULATE
  emulated_settle(sums, sizeof sums);
#else
#pragma unroll
  for (int i = 0; i < kRows * kColumns; ++i) asm volatile("" : "+f"(sums[i / kColumns][i % kColumns])::"memory");
#endif
}
__device__ __forceinline__ void group_settle(uint32_t (&operand)[4]) {
#ifdef VN_EMULATE
  emulated_settle(operand, sizeof operand);
#else
#pragma unroll
  for (int i = 0; i < 4; ++i) asm volatile("" : "+r"(operand[i])::"memory");
#endif
}

__device__ __forceinline__ void group_fence() {
#ifdef VN_EMULATE
  emulated_group_fence();
#elif defined(__CUDA_ARCH_FEAT_SM90_ALL)
  asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
#else
  __trap();
#endif
}

// Closes a set of products, which are waited for together.
__device__ __forceinline__ void group_commit() {
#ifdef VN_EMULATE
  emulated_group_commit();
#elif defined(__CUDA_ARCH_FEAT_SM90_ALL)
  asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
#else
  __trap();
#endif
}

// Waits until at most kPending sets, the last ones, are under way.
template <int kPending>
__device__ __forceinline__ void group_wait() {
#ifdef VN_EMULATE
  emulated_group_wait(kPending);
#elif defined(__CUDA_ARCH_FEAT_SM90_ALL)
  asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(kPending) : "memory");
#else
  __trap();
#endif
}

#define VN_GROUP_PRODUCT(shape, type, sums, operand, matrix, ...)                                                \
  asm volatile("wgmma.mma_async.sync.aligned." shape ".f32." type "." type " {" sums "}, {" operand "}, " matrix \
               ", 1, 1, 1, 0;"                                                                                   \
               : __VA_ARGS__                                                                                     \
               : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "l"(b))
#define VN_GROUP_PRODUCTS(shape, ...)               \
  do {                                              \
    if constexpr (kBfloat16) {                      \
      VN_GROUP_PRODUCT(shape, "bf16", __VA_ARGS__); \
    } else {                                        \
      VN_GROUP_PRODUCT(shape, "f16", __VA_ARGS__);  \
    }                                               \
  } while (false)
#define VN_SUMS(t) "+f"(d[t][0]), "+f"(d[t][1]), "+f"(d[t][2]), "+f"(d[t][3])

// Begins d [64][8 kTiles] += a [64][16] b [8 kTiles][16]^T in float32 for the group: a thread's part of a and d, and
// what names b, the same in all of its threads.
template <bool kBfloat16, int kTiles>
__device__ __forceinline__ void group_multiply(float (&d)[kTiles][4], const uint32_t (&a)[4], uint64_t b) {
  static_assert(kTiles == 1 || kTiles == 2 || kTiles == 4 || kTiles == 8, "there are 8, 16, 32 and 64 columns");
#ifdef VN_EMULATE
  emulated_group_multiply(d[0], kTiles, a, b, kBfloat16);
#elif defined(__CUDA_ARCH_FEAT_SM90_ALL)
  if constexpr (kTiles == 1) {
    VN_GROUP_PRODUCTS("m64n8k16", "%0, %1, %2, %3", "%4, %5, %6, %7", "%8", VN_SUMS(0));
  } else if constexpr (kTiles == 2) {
    VN_GROUP_PRODUCTS("m64n16k16", "%0, %1, %2, %3, %4, %5, %6, %7", "%8, %9, %10, %11", "%12", VN_SUMS(0), VN_SUMS(1));
  } else if constexpr (kTiles == 4) {
    VN_GROUP_PRODUCTS("m64n32k16", "%0, %1, %2, %3, %4, %5, %6, %7, %8, %9, %10, %11, %12, %13, %14, %15",
                      "%16, %17, %18, %19", "%20", VN_SUMS(0), VN_SUMS(1), VN_SUMS(2), VN_SUMS(3));
  } else {
    VN_GROUP_PRODUCTS("m64n64k16",
                      "%0, %1, %2, %3, %4, %5, %6, %7, %8, %9, %10, %11, %12, %13, %14, %15, %16, %17, %18, %19, %20, "
                      "%21, %22, %23, %24, %25, %26, %27, %28, %29, %30, %31",
                      "%32, %33, %34, %35", "%36", VN_SUMS(0), VN_SUMS(1), VN_SUMS(2), VN_SUMS(3), VN_SUMS(4),
                      VN_SUMS(5), VN_SUMS(6), VN_SUMS(7));
  }
#else
  __trap();
#endif
}

#undef VN_SUMS
#undef VN_GROUP_PRODUCTS
#undef VN_GROUP_PRODUCT

}  // namespace voronerf
