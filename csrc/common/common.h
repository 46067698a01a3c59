// The macros and helpers that every file may use. They do not depend on torch, only on the standard library and, under
// nvcc, on the CUDA toolkit.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>

#include "common/hd.h"

#if defined(__CUDACC__) || defined(VN_EMULATE)
#ifdef __CUDACC__
#include <cuda_runtime.h>
#else
#include "emulation.h"
#endif
// Throws an exception that names the call on a CUDA error. Launches are checked with cudaGetLastError(), which does not
// synchronise: a fault inside a kernel appears at the caller's next synchronisation.
#define VN_CUDA_CHECK(call)                                                               \
  do {                                                                                    \
    const cudaError_t vn_error = (call);                                                  \
    if (vn_error != cudaSuccess) {                                                        \
      throw std::runtime_error(std::string(#call ": ") + ::cudaGetErrorString(vn_error)); \
    }                                                                                     \
  } while (false)
#endif

// Checks an internal invariant. Arguments that Python has validated are not validated again.
#define VN_CHECK(condition, message)                     \
  do {                                                   \
    if (!(condition)) throw std::runtime_error(message); \
  } while (false)

namespace voronerf {

template <typename T>
VN_HD constexpr T ceil_div(T a, T b) {
  return (a + b - 1) / b;
}

}  // namespace voronerf
