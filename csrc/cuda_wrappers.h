// The one header that knows how a .cu file is compiled: by nvcc for a GPU, or by g++ under VN_EMULATE for the tests
// that run the same source on the CPU (tests/cuda_emulation). Launches and shared memory go through macros, because
// CUDA's own words for them mean nothing, or something else, to g++:
//
//   VN_LAUNCH((kernel<64>), grid, block, bytes, stream, arguments...)     checked
//   VN_SHARED(name, float[8][64]);   VN_DYN_SHARED(float4, name);
//
// Below them are the instructions that CUDA C++ has no function for.
#pragma once

#include "common.h"

#ifdef VN_EMULATE
#include "emulation.h"
#else
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

}  // namespace voronerf
