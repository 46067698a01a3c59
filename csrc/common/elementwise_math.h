// Vector sine, exponential and the activations built on them, accurate to about 1e-7. Each is one range reduction and a
// polynomial.
#pragma once

#include "common/simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

typedef int32_t Bits __attribute__((vector_size(4 * kLanes)));

// Adding 1.5 * 2^23 rounds to the nearest integer, which is then in the low bits of the sum.
constexpr float kRound = 12582912.0f;
// The largest angle of the vector sine. Beyond it the reduction is not exact, and the scalar function is the fallback.
constexpr float kLargestAngle = VN_ISA == 0 ? 8192.0f : 65536.0f;

// Returns angle - multiple * pi, where `multiple` is a multiple of 0.5 and |angle| <= kLargestAngle.
VN_INLINE F32 less_multiple_of_pi(F32 angle, F32 multiple) {
#if VN_ISA == 0
  // Without fused multiply-add, pi is split into parts so short that their products are exact.
  const F32 r = angle - multiple * splat(3.140625f) - multiple * splat(9.67502593994140625e-4f);
  return r - multiple * splat(1.509957990978376432e-7f);
#else
  return fma(multiple, splat(8.74227765734758577e-8f), fma(multiple, splat(-3.14159274101257324f), angle));
#endif
}

// Computes sin(angle + half * pi) in place for |angle| <= kLargestAngle, with half 0 or 0.5 (the cosine). With angle =
// (m - half) pi + r and |r| <= pi / 2, the result is (-1)^m sin r. Pi is split into parts, so r is exact up to
// rounding. The polynomial's error is 5e-9. N vectors are interleaved to hide latency: one sine is a chain of a dozen
// dependent operations.
template <int N>
VN_INLINE void sines(F32* angle, const F32* half) {
  F32 shifted[N], r[N], u[N], p[N];
  for (int i = 0; i < N; ++i) shifted[i] = fma(angle[i], splat(0.318309886f), half[i]) + splat(kRound);
  for (int i = 0; i < N; ++i) r[i] = less_multiple_of_pi(angle[i], shifted[i] - splat(kRound) - half[i]);
  for (int i = 0; i < N; ++i) u[i] = r[i] * r[i];
  for (int i = 0; i < N; ++i) p[i] = fma(u[i], splat(2.59944752e-06f), splat(-1.98063418e-04f));
  for (int i = 0; i < N; ++i) p[i] = fma(u[i], p[i], splat(8.33301353e-03f));
  for (int i = 0; i < N; ++i) p[i] = fma(u[i], p[i], splat(-1.66666569e-01f));
  for (int i = 0; i < N; ++i) {
    const F32 value = fma(r[i] * u[i], p[i], r[i]);
    angle[i] = reinterpret_cast<F32>(reinterpret_cast<Bits>(value) ^ (reinterpret_cast<Bits>(shifted[i]) << 31));
  }
}

// Computes sines and cosines of N vectors of angles up to kLargestAngle, from one reduction: angle = k pi/2 + r, |r| <=
// pi/4.
template <int N>
VN_INLINE void sines_and_cosines(const F32* angle, F32* sine, F32* cosine) {
  const F32 round = splat(0.5f * kRound);  // rounds half turns to multiples of 1/2
  F32 turns[N], r[N], u[N], s[N], c[N];
  for (int i = 0; i < N; ++i) turns[i] = fma(angle[i], splat(0.318309886f), round);
  for (int i = 0; i < N; ++i) r[i] = less_multiple_of_pi(angle[i], turns[i] - round);
  for (int i = 0; i < N; ++i) u[i] = r[i] * r[i];
  for (int i = 0; i < N; ++i) s[i] = fma(u[i], splat(-1.95152959e-4f), splat(8.33216087e-3f));
  for (int i = 0; i < N; ++i) c[i] = fma(u[i], splat(2.44331571e-5f), splat(-1.38873163e-3f));
  for (int i = 0; i < N; ++i) s[i] = fma(u[i], s[i], splat(-1.66666546e-1f));
  for (int i = 0; i < N; ++i) c[i] = fma(u[i], c[i], splat(4.16666457e-2f));
  for (int i = 0; i < N; ++i) s[i] = fma(r[i] * u[i], s[i], r[i]);
  for (int i = 0; i < N; ++i) c[i] = fma(u[i], fma(u[i], c[i], splat(-0.5f)), splat(1.0f));
  for (int i = 0; i < N; ++i) {
    const Bits k = reinterpret_cast<Bits>(turns[i]), top = reinterpret_cast<Bits>(splat(-0.0f));
    const auto odd = (k & 1) != 0;
    const F32 first = odd ? c[i] : s[i], second = odd ? s[i] : c[i];
    sine[i] = reinterpret_cast<F32>(reinterpret_cast<Bits>(first) ^ (k << 30 & top));
    cosine[i] = reinterpret_cast<F32>(reinterpret_cast<Bits>(second) ^ ((k + 1) << 30 & top));
  }
}

VN_INLINE F32 sine(F32 angle, F32 half) {
  sines<1>(&angle, &half);
  return angle;
}

// The factors of e^x = scale (1 + p), with x clamped to the range of float32; NaN passes through.
struct Exponential {
  F32 scale, p;
};

VN_INLINE Exponential exponential_parts(F32 x) {
  x = min(splat(88.0f), max(splat(-87.0f), x));  // min and max return the second operand if it is NaN
  const F32 shifted = fma(x, splat(1.44269504f), splat(kRound));
  const F32 n = shifted - splat(kRound);
  F32 r = fma(n, splat(-0.693145752f), x);
  r = fma(n, splat(-1.42860677e-6f), r);
  F32 p = fma(r, splat(1.99064926e-04f), splat(1.39421662e-03f));
  p = fma(r, p, splat(8.33328669e-03f));
  p = fma(r, p, splat(4.16663401e-02f));
  p = fma(r, p, splat(1.66666668e-01f));
  p = fma(r, p, splat(0.5f));
  const Bits exponent = reinterpret_cast<Bits>(shifted) - reinterpret_cast<Bits>(splat(kRound)) + 127;
  return {reinterpret_cast<F32>(exponent << 23), fma(r * r, p, r)};
}

VN_INLINE F32 exponential(F32 x) {
  const Exponential e = exponential_parts(x);
  return fma(e.scale, e.p, e.scale);
}

// Returns e^x - 1, accurate around 0.
VN_INLINE F32 exponential_minus_one(F32 x) {
  const Exponential e = exponential_parts(x);
  return fma(e.scale, e.p, e.scale - splat(1.0f));
}

// Returns log(1 + e^x) = max(x, 0) + log1p(t) with t = e^-|x| and log1p(t) = 2 atanh(t / (2 + t)), whose series is
// short for t <= 1. Denormals, which take the processor ten times as long, are avoided: t is at least e^-80, u at least
// 1e-20.
VN_INLINE F32 softplus(F32 x) {
  const F32 size = x < splat(0.0f) ? x : splat(0.0f) - x;
  const F32 t = exponential(size < splat(-80.0f) ? splat(-80.0f) : size);
  const F32 s = t / (splat(2.0f) + t);
  const F32 u = fma(s, s, splat(1e-20f));
  F32 p = splat(1.0f / 15);
  p = fma(u, p, splat(1.0f / 13));
  p = fma(u, p, splat(1.0f / 11));
  p = fma(u, p, splat(1.0f / 9));
  p = fma(u, p, splat(1.0f / 7));
  p = fma(u, p, splat(1.0f / 5));
  p = fma(u, p, splat(1.0f / 3));
  p = fma(u, p, splat(1.0f));
  return fma(s + s, p, x < splat(0.0f) ? splat(0.0f) : x);
}

VN_INLINE F32 sigmoid(F32 x) { return splat(1.0f) / (splat(1.0f) + exponential(splat(0.0f) - x)); }

// Returns whether a lane is too large for `sine`, or not finite.
VN_INLINE bool beyond_sine(F32 angle) { return bits(less(abs(angle), splat(kLargestAngle))) != (1u << kLanes) - 1u; }

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
