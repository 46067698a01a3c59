// The functions of programs, each with its first three derivatives. x is the argument, a and b are constants of the
// function.
//
// F32 is a vector on the CPU (functions_tile.h) and a float on CUDA (program_cuda.cu). The including file defines
// VN_ISA_NAMESPACE, VN_INLINE and, in that namespace, F32, splat, fma, abs, softplus, exponential_minus_one,
// any_exponential (e^x), any_sine, logarithm, square_root and rounded_down.
#pragma once

#include "network/function_table.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

VN_INLINE F32 constant(float a) { return splat(a); }

// Selects `yes` in lanes with x > 0 and `no` in the other lanes.
VN_INLINE F32 positive(F32 x, F32 yes, F32 no) { return x > splat(0.0f) ? yes : no; }

// Returns the derivative of x^(p + order) of order `order`: (p + order) (p + order - 1) ... (p + 1) x^p. If p is a
// multiple of 0.5, the power is computed by multiplications and a square root.
VN_INLINE F32 raised(F32 x, float p, int order) {
  float factor = 1.0f;
  for (int i = 0; i < order; ++i) factor *= p + static_cast<float>(order - i);
  const float size = p < 0.0f ? -p : p;
  if (size > 1e6f || size + size != static_cast<float>(static_cast<int>(size + size))) {
    return splat(factor) * any_exponential(splat(p) * logarithm(x));
  }
  int whole = static_cast<int>(size);
  F32 result = size > static_cast<float>(whole) ? square_root(x) : splat(1.0f);
  for (F32 power = x; whole > 0; whole >>= 1, power = power * power) {
    if (whole & 1) result = result * power;
  }
  return splat(factor) * (p < 0.0f ? splat(1.0f) / result : result);
}

// Returns log(1 + x). Around 0, the factor x / ((1 + x) - 1) corrects the rounding of 1 + x (Kahan).
VN_INLINE F32 logarithm_of_one_plus(F32 x) {
  const F32 one = splat(1.0f), sum = one + x, rounded = sum - one;
  const F32 near = rounded == splat(0.0f) ? x : logarithm(sum) * (x / rounded);
  return x < one ? near : logarithm(sum);
}

VN_INLINE F32 hyperbolic_tangent(F32 x) {
  const F32 t = exponential_minus_one(splat(-2.0f) * abs(x)), size = splat(0.0f) - t / (t + splat(2.0f));
  return x < splat(0.0f) ? splat(0.0f) - size : size;
}

// Returns the derivative of tanh, 1 - tanh^2, without cancellation.
VN_INLINE F32 tangent_slope(F32 x) {
  const F32 e = any_exponential(splat(-2.0f) * abs(x)), sum = splat(1.0f) + e;
  return splat(4.0f) * e / (sum * sum);
}

// Clamps x to the range in which the normal density is not 0, so that 0 times a power of x is never 0 times infinity.
VN_INLINE F32 nearby(F32 x) { return x > splat(30.0f) ? splat(30.0f) : x < splat(-30.0f) ? splat(-30.0f) : x; }

// Returns the density of the normal distribution.
VN_INLINE F32 density(F32 x) { return splat(0.39894228f) * any_exponential(splat(-0.5f) * x * x); }

// Returns the normal distribution function, erfc(-x / sqrt 2) / 2. erfc is Numerical Recipes' erfcc, with a relative
// error of 1.2e-7.
VN_INLINE F32 distribution(F32 x) {
  const F32 z = abs(x) * splat(0.70710678f), t = splat(1.0f) / fma(z, splat(0.5f), splat(1.0f));
  constexpr float kSeries[] = {0.17087277f,  -0.82215223f, 1.48851587f, -1.13520398f, 0.27886807f,
                               -0.18628806f, 0.09678418f,  0.37409196f, 1.00002368f,  -1.26551223f};
  F32 p = splat(kSeries[0]);
  for (int i = 1; i < 10; ++i) p = fma(p, t, splat(kSeries[i]));
  const F32 tail = splat(0.5f) * t * any_exponential(p - z * z);
  return x > splat(0.0f) ? splat(1.0f) - tail : tail;
}

// Returns erf x = 2 Phi(sqrt 2 x) - 1, computed by its series around 0.
VN_INLINE F32 error_function(F32 x) {
  const F32 u = x * x;
  F32 p = fma(u, splat(1.0f / 9360), splat(-1.0f / 1320));
  p = fma(u, p, splat(1.0f / 216));
  p = fma(u, p, splat(-1.0f / 42));
  p = fma(u, p, splat(0.1f));
  p = fma(u, p, splat(-1.0f / 3));
  p = fma(u, p, splat(1.0f));
  return abs(x) < splat(0.5f) ? splat(1.12837917f) * x * p
                              : fma(splat(2.0f), distribution(splat(1.41421356f) * x), splat(-1.0f));
}

// Returns the arctangent, by the polynomial of Cephes' atanf for |t| <= tan(pi / 8).
VN_INLINE F32 arctangent(F32 x) {
  const F32 size = abs(x), one = splat(1.0f), far = splat(2.41421356f), half = splat(0.41421356f);
  const F32 t = size > far ? splat(-1.0f) / size : size > half ? (size - one) / (size + one) : size, u = t * t;
  F32 p = fma(u, splat(8.05374450e-2f), splat(-1.38776856e-1f));
  p = fma(u, p, splat(1.99777107e-1f));
  p = fma(u, p, splat(-3.33329491e-1f));
  p = fma(u * t, p, t) + (size > far ? splat(1.57079633f) : size > half ? splat(0.785398163f) : splat(0.0f));
  return x < splat(0.0f) ? splat(0.0f) - p : p;
}

// Returns the derivative of the arctangent.
VN_INLINE F32 arctangent_slope(F32 x) { return splat(1.0f) / fma(x, x, splat(1.0f)); }

// Returns a derivative of the logistic function (order 0: the function).
template <int Order>
VN_INLINE F32 logistic(F32 x) {
  const F32 one = splat(1.0f), e = x < splat(-87.0f) ? splat(__builtin_inff()) : any_exponential(splat(0.0f) - x);
  const F32 s = one / (one + e), slope = s * (one - s);
  if (Order == 0) return s;
  if (Order == 1) return slope;
  return slope * (Order == 2 ? one - s - s : one - splat(6.0f) * slope);
}

// Returns a derivative of the tanh approximation of GELU, x (1 + T) / 2 with T = tanh u, u = c (x + d x^3).
template <int Order>
VN_INLINE F32 gelu_by_tanh(F32 x) {
  const F32 c = splat(0.79788456f), d = splat(0.044715f), half = splat(0.5f), one = splat(1.0f), xx = x * x;
  const F32 u = c * x * fma(d, xx, one), t = hyperbolic_tangent(u), s = tangent_slope(u);
  if (Order == 0) return half * x * (one + t);
  const F32 u1 = c * fma(splat(3.0f) * d, xx, one), u2 = splat(6.0f) * c * d * x, t1 = s * u1;
  if (Order == 1) return half * (one + t) + half * x * t1;
  const F32 t2 = s * (u2 - splat(2.0f) * t * u1 * u1);
  if (Order == 2) return t1 + half * x * t2;
  const F32 t3 = splat(6.0f) * c * d - splat(6.0f) * t * u1 * u2 + (splat(6.0f) * t * t - splat(2.0f)) * u1 * u1 * u1;
  return splat(1.5f) * t2 + half * x * s * t3;
}

#define VN_FUNCTION(NAME, F0, F1, F2, F3)                                                          \
  struct NAME##_function {                                                                         \
    template <int Order>                                                                           \
    VN_INLINE F32 at([[maybe_unused]] F32 x, [[maybe_unused]] float a, [[maybe_unused]] float b) { \
      [[maybe_unused]] const F32 zero = splat(0.0f), one = splat(1.0f);                            \
      if constexpr (Order == 0) {                                                                  \
        return F0;                                                                                 \
      } else if constexpr (Order == 1) {                                                           \
        return F1;                                                                                 \
      } else if constexpr (Order == 2) {                                                           \
        return F2;                                                                                 \
      } else {                                                                                     \
        return F3;                                                                                 \
      }                                                                                            \
    }                                                                                              \
  };

VN_FUNCTIONS(VN_FUNCTION)
#undef VN_FUNCTION

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
