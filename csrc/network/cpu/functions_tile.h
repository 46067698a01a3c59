// The vector functions from which network/functions.h builds the functions of programs.
#pragma once

#include "common/elementwise_math.h"
#include "common/memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Returns log x. With x = 2^e m and m from sqrt(1/2) to sqrt 2, it is e log 2 + 2 atanh((m - 1) / (m + 1)).
VN_INLINE F32 logarithm(F32 x) {
  const F32 zero = splat(0.0f), one = splat(1.0f), least = splat(1.17549435e-38f);
  const F32 normal = x < least ? x * splat(8388608.0f) : x;
  const Bits bits = reinterpret_cast<Bits>(normal);
  F32 e = __builtin_convertvector((bits >> 23) - 127, F32), m = reinterpret_cast<F32>((bits & 0x7fffff) | 0x3f800000);
  e = x < least ? e - splat(23.0f) : e;
  e = m > splat(1.41421356f) ? e + one : e;
  m = m > splat(1.41421356f) ? splat(0.5f) * m : m;
  const F32 s = (m - one) / (m + one), u = s * s;
  F32 p = fma(u, splat(1.0f / 9), splat(1.0f / 7));
  p = fma(u, p, splat(1.0f / 5));
  p = fma(u, p, splat(1.0f / 3));
  p = fma(u * (s + s), p, s + s);
  const F32 result = fma(e, splat(0.693359375f), fma(e, splat(-2.12194440e-4f), p));
  const F32 infinite = splat(__builtin_inff());
  return x > zero ? (x < infinite ? result : x) : x == zero ? zero - infinite : splat(__builtin_nanf(""));
}

VN_INLINE F32 rounded_down(F32 x) {
  float lanes[kLanes];
  store(lanes, x);
  for (int i = 0; i < kLanes; ++i) lanes[i] = __builtin_floorf(lanes[i]);
  return load(lanes);
}

// Returns the sine or cosine if some angles are too large for `sine`; the scalar function computes them. The choice is
// made per lane, so other lanes, such as stale floats in padding lanes, do not change a result.
__attribute__((noinline)) F32 careful_sine(F32 angle, bool cosine) {
  float lanes[kLanes], angles[kLanes];
  store(lanes, sine(angle, splat(cosine ? 0.5f : 0.0f)));
  store(angles, angle);
  for (int i = 0; i < kLanes; ++i) {
    if (__builtin_fabsf(angles[i]) < kLargestAngle) continue;
    lanes[i] = cosine ? __builtin_cosf(angles[i]) : __builtin_sinf(angles[i]);
  }
  return load(lanes);
}

VN_INLINE F32 any_sine(F32 angle, bool cosine) {
  if (__builtin_expect(beyond_sine(angle), false)) return careful_sine(angle, cosine);
  return sine(angle, splat(cosine ? 0.5f : 0.0f));
}

// Returns e^x down to 0 and up to infinity. `exponential` is clamped to e^-87 and e^88, but e^-87 times a large x is
// not 0. Denormal results are 0, since denormals take the processor ten times as long.
VN_INLINE F32 any_exponential(F32 x) {
  const F32 root = x < splat(-87.0f) ? splat(0.0f) : exponential(splat(0.5f) * x);
  return root * root;
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#define VN_WORDS
#include "network/functions.h"
