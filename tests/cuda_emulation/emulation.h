// Replaces CUDA for g++: the same .cu sources run on the CPU, block by block, with every thread as a fiber. For tests
// only: csrc/common/cuda_wrappers.h includes it under VN_EMULATE. Threads of a block run in a shuffled order that
// depends on a seed. They stop at barriers and at warp operations, which all lanes must reach. In half of the blocks, a
// warp runs to its next barrier of the block before the other warps do. Shared memory is poisoned before every block.
// The emulation checks logic, not speed. It has no partial warps: every mask has all 32 lanes.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <string>
#include <type_traits>
#include <vector>

#include "emulation_atomics.h"

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)

struct dim3 {
  unsigned x, y, z;
  dim3(unsigned x_ = 1, unsigned y_ = 1, unsigned z_ = 1) : x(x_), y(y_), z(z_) {}
};

struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
struct alignas(8) uint2 {
  unsigned x, y;
};
struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
inline float2 make_float2(float x, float y) {
  return {x, y};
}
inline float4 make_float4(float x, float y, float z, float w) {
  return {x, y, z, w};
}
// The part of the CUDA runtime that the launchers use.
using cudaStream_t = void*;
using cudaError_t = int;
constexpr cudaError_t cudaSuccess = 0;
enum cudaFuncAttribute { cudaFuncAttributeMaxDynamicSharedMemorySize };
enum cudaDeviceAttr {
  cudaDevAttrMaxSharedMemoryPerBlockOptin,
  cudaDevAttrMultiProcessorCount,
  cudaDevAttrComputeCapabilityMajor,
  cudaDevAttrComputeCapabilityMinor,
};
inline const char* cudaGetErrorString(cudaError_t) {
  return "error of the emulation";
}
inline cudaError_t cudaGetLastError() {
  return cudaSuccess;
}
inline cudaError_t cudaSetDevice(int) {
  return cudaSuccess;
}
inline cudaError_t cudaMemsetAsync(void* to, int value, size_t size, cudaStream_t) {
  std::memset(to, value, size);
  return cudaSuccess;
}
constexpr cudaError_t cudaErrorInvalidValue = 1;
struct cudaFuncAttributes {
  int ptxVersion;
};

namespace vn_emulation {

constexpr size_t kSlot = 64;  // bytes that a lane may pass to other lanes

struct Settings {
  uint64_t seed = 0;
  int device = 0;           // number of the device, increased with each change of the other settings
  int capability = 90;      // compute capability of the emulated device
  int compiled = 120;       // architecture of the compiled kernels
  int multiprocessors = 2;  // few, so that grid-stride loops run several times
  int shared = 227 * 1024;  // shared memory per block in bytes
};
Settings& settings();

// Launches the kernel run(context). Throws std::runtime_error for errors that would hang or fault on a GPU.
void launch(void (*run)(void*), void* context, dim3 grid, dim3 block, size_t dynamic_bytes);

// Static shared memory of a block: one piece for each declaration in the source, identified by `key`.
void* shared(const void* key, size_t size);
void* dynamic_shared();

// block_barrier waits for all threads of the block. meet waits for all lanes of the warp: each lane passes `size` bytes
// and gets the bytes of all lanes [32][kSlot]. `ordered` makes earlier memory writes visible to the other lanes; in
// CUDA only __syncwarp does so.
void block_barrier();
const unsigned char* meet(const char* operation, const void* mine, size_t size, bool ordered = false);
int lane();

struct Index {
  unsigned x = 0, y = 0, z = 0;
};
extern Index thread_index, block_index;
extern dim3 block_size, grid_size;

template <typename Launch>
void launch_of(const Launch& run, dim3 grid, dim3 block, size_t dynamic_bytes) {
  launch([](void* context) { (*static_cast<const Launch*>(context))(); }, const_cast<Launch*>(&run), grid, block,
         dynamic_bytes);
}

// Called after each launch, if set: with the kernel's name in the source, the sizes, and the bytes of the arguments as in
// CUDA's parameter buffer.
using Watcher = std::function<void(const char* name, dim3 grid, dim3 block, size_t dynamic_bytes, const std::string&)>;
Watcher& watcher();

template <typename... Parameters, typename... Arguments>
void tell_watcher(const char* name, void (*)(Parameters...), dim3 grid, dim3 block, size_t dynamic_bytes,
                  const Arguments&... arguments) {
  if (!watcher()) return;
  std::string packed;
  const auto pack = [&packed](const auto& parameter) {
    while (packed.size() % alignof(decltype(parameter)) != 0) packed.push_back('\0');
    packed.append(reinterpret_cast<const char*>(&parameter), sizeof parameter);
  };
  (pack(static_cast<const Parameters&>(arguments)), ...);
  watcher()(name, grid, block, dynamic_bytes, packed);
}

template <typename T>
T from_lane(const unsigned char* slots, int lane) {
  T value;
  std::memcpy(&value, slots + lane * kSlot, sizeof(T));
  return value;
}

void require_all(unsigned mask);
[[noreturn]] void fail(const std::string& message);

}  // namespace vn_emulation

inline cudaError_t cudaGetDevice(int* device) {
  *device = vn_emulation::settings().device;
  return cudaSuccess;
}
inline cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr attribute, int) {
  const auto& settings = vn_emulation::settings();
  switch (attribute) {
    case cudaDevAttrMaxSharedMemoryPerBlockOptin:
      *value = settings.shared;
      break;
    case cudaDevAttrMultiProcessorCount:
      *value = settings.multiprocessors;
      break;
    case cudaDevAttrComputeCapabilityMajor:
      *value = settings.capability / 10;
      break;
    case cudaDevAttrComputeCapabilityMinor:
      *value = settings.capability % 10;
      break;
  }
  return cudaSuccess;
}

template <typename Kernel>
cudaError_t cudaFuncGetAttributes(cudaFuncAttributes* attributes, Kernel) {
  attributes->ptxVersion = vn_emulation::settings().compiled;
  return cudaSuccess;
}
// Returns an error unless a kernel requests all shared memory: host threads with different values would overwrite each
// other's limit.
template <typename Kernel>
cudaError_t cudaFuncSetAttribute(Kernel, cudaFuncAttribute, int value) {
  return value == vn_emulation::settings().shared ? cudaSuccess : cudaErrorInvalidValue;
}

#define threadIdx vn_emulation::thread_index
#define blockIdx vn_emulation::block_index
#define blockDim vn_emulation::block_size
#define gridDim vn_emulation::grid_size

#define VN_LAUNCH(kernel, grid, block, bytes, stream, ...)                                    \
  ((void)(stream), vn_emulation::launch_of([&] { kernel(__VA_ARGS__); }, grid, block, bytes), \
   vn_emulation::tell_watcher(#kernel, kernel, grid, block, bytes, __VA_ARGS__))
#define VN_SHARED(name, ...)        \
  using name##_type = __VA_ARGS__;  \
  static const char name##_key = 0; \
  name##_type& name = *static_cast<name##_type*>(vn_emulation::shared(&name##_key, sizeof(name##_type)))
#define VN_DYN_SHARED(T, name) T* name = static_cast<T*>(vn_emulation::dynamic_shared())

// CUDA intrinsics. All lanes of a warp must reach the same warp operation.

inline void __syncthreads() {
  vn_emulation::block_barrier();
}

inline void __syncwarp(unsigned mask = 0xffffffffu) {
  vn_emulation::require_all(mask);
  vn_emulation::meet("__syncwarp", nullptr, 0, true);
}

template <typename T>
T __shfl_sync(unsigned mask, T value, int source) {
  vn_emulation::require_all(mask);
  return vn_emulation::from_lane<T>(vn_emulation::meet("__shfl_sync", &value, sizeof value), source & 31);
}

template <typename T>
T __shfl_up_sync(unsigned mask, T value, unsigned delta) {
  vn_emulation::require_all(mask);
  const int source = vn_emulation::lane() - static_cast<int>(delta);
  const unsigned char* slots = vn_emulation::meet("__shfl_up_sync", &value, sizeof value);
  return source < 0 ? value : vn_emulation::from_lane<T>(slots, source);
}

template <typename T>
T __shfl_down_sync(unsigned mask, T value, unsigned delta) {
  vn_emulation::require_all(mask);
  const int source = vn_emulation::lane() + static_cast<int>(delta);
  const unsigned char* slots = vn_emulation::meet("__shfl_down_sync", &value, sizeof value);
  return source > 31 ? value : vn_emulation::from_lane<T>(slots, source);
}

template <typename T>
T __shfl_xor_sync(unsigned mask, T value, int other) {
  vn_emulation::require_all(mask);
  const int source = vn_emulation::lane() ^ other;
  return vn_emulation::from_lane<T>(vn_emulation::meet("__shfl_xor_sync", &value, sizeof value), source);
}

template <typename T>
unsigned __match_any_sync(unsigned mask, T value) {
  vn_emulation::require_all(mask);
  const unsigned char* slots = vn_emulation::meet("__match_any_sync", &value, sizeof value);
  unsigned peers = 0;
  for (int lane = 0; lane < 32; ++lane) {
    if (vn_emulation::from_lane<T>(slots, lane) == value) peers |= 1u << lane;
  }
  return peers;
}

inline unsigned __ballot_sync(unsigned mask, int predicate) {
  vn_emulation::require_all(mask);
  const unsigned char* slots = vn_emulation::meet("__ballot_sync", &predicate, sizeof predicate);
  unsigned votes = 0;
  for (int lane = 0; lane < 32; ++lane) {
    if (vn_emulation::from_lane<int>(slots, lane) != 0) votes |= 1u << lane;
  }
  return votes;
}

inline int __ffs(int x) {
  return __builtin_ffs(x);
}
inline int __clz(int x) {
  return x == 0 ? 32 : __builtin_clz(static_cast<unsigned>(x));
}
inline int __popc(unsigned x) {
  return __builtin_popcount(x);
}

namespace voronerf {

// Emulates the instructions of csrc/common/cuda_wrappers.h, with the fragment layouts of the PTX manual (section
// "Matrix fragments for mma.m16n8k16" and the next ones).

inline unsigned half_bits(float x, bool bfloat16) {
  if (!bfloat16) {
    const _Float16 rounded = static_cast<_Float16>(x);
    uint16_t bits;
    std::memcpy(&bits, &rounded, sizeof bits);
    return bits;
  }
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  if (std::isnan(x)) return 0x7fff;
  return (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
}

inline float half_value(unsigned bits, bool bfloat16) {
  if (bfloat16) {
    const uint32_t wide = static_cast<uint32_t>(bits & 0xffffu) << 16;
    float value;
    std::memcpy(&value, &wide, sizeof value);
    return value;
  }
  const uint16_t narrow = static_cast<uint16_t>(bits);
  _Float16 value;
  std::memcpy(&value, &narrow, sizeof value);
  return static_cast<float>(value);
}

enum class Multiplied { bfloat16, float16, tf32 };
// d [16][8] += a b for operands of a type; defined in emulated_products.cpp.
void emulated_multiply(Multiplied type, float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]);

}  // namespace voronerf
