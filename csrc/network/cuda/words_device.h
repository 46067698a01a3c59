// Scalar functions, from which network/functions.h builds the functions of programs, and encoding/encodings.h builds
// the formulas of encodings. F32 is one float per thread.
#pragma once

#include <cmath>

#define VN_ISA_NAMESPACE device
#define VN_INLINE static __device__ __forceinline__

namespace voronerf {
namespace device {
namespace {

using F32 = float;
VN_INLINE float splat(float x) { return x; }
VN_INLINE float fma(float a, float b, float c) { return fmaf(a, b, c); }
VN_INLINE float abs(float x) { return fabsf(x); }
VN_INLINE float any_exponential(float x) { return expf(x); }
VN_INLINE float exponential_minus_one(float x) { return expm1f(x); }
VN_INLINE float softplus(float x) { return (x > 0.0f ? x : 0.0f) + log1pf(expf(-fabsf(x))); }
VN_INLINE float any_sine(float angle, bool cosine) { return cosine ? cosf(angle) : sinf(angle); }
VN_INLINE float logarithm(float x) { return logf(x); }
VN_INLINE float square_root(float x) { return sqrtf(x); }
VN_INLINE float rounded_down(float x) { return floorf(x); }

}  // namespace
}  // namespace device
}  // namespace voronerf

#define VN_WORDS
