// The functions of programs, as DO(name, f(x), f'(x), f''(x), f'''(x)) in terms of functions.h. Python refers to them
// by name (FUNCTIONS in voronerf/ops/_core/program.py).
#pragma once

#define VN_FUNCTIONS(DO)                                                                                              \
  DO(copy, x, one, zero, zero)                                                                                        \
  DO(stop, x, zero, zero, zero)                                                                                       \
  DO(step, positive(x, one, zero), zero, zero, zero)                                                                  \
  DO(at_least, x >= zero ? one : zero, zero, zero, zero)                                                              \
  DO(floor, rounded_down(x), zero, zero, zero)                                                                        \
  DO(affine, fma(splat(a), x, splat(b)), splat(a), zero, zero)                                                        \
  DO(relu, x < zero ? zero : x, x <= zero ? zero : one, zero, zero)                                                   \
  DO(leaky_relu, positive(x, x, splat(a) * x), positive(x, one, splat(a)), zero, zero)                                \
  DO(abs, abs(x), positive(x, one, x < zero ? zero - one : zero), zero, zero)                                         \
  DO(clamp, x<splat(a) ? splat(a) : x> splat(b) ? splat(b) : x, x >= splat(a) ? (x <= splat(b) ? one : zero) : zero,  \
     zero, zero)                                                                                                      \
  DO(hardtanh, x<splat(a) ? splat(a) : x> splat(b) ? splat(b) : x,                                                    \
     x <= splat(a) ? zero : (x >= splat(b) ? zero : one), zero, zero)                                                 \
  DO(elu, positive(x, x, splat(a) * exponential_minus_one(x)), positive(x, one, splat(a) * any_exponential(x)),       \
     x >= zero ? zero : splat(a) * any_exponential(x), x >= zero ? zero : splat(a) * any_exponential(x))              \
  DO(softplus, splat(a) * x > splat(b) ? x : softplus(splat(a) * x) * splat(1.0f / a),                                \
     splat(a) * x > splat(b) ? one : logistic<0>(splat(a) * x),                                                       \
     splat(a) * x > splat(b) ? zero : splat(a) * logistic<1>(splat(a) * x),                                           \
     splat(a) * x > splat(b) ? zero : splat(a * a) * logistic<2>(splat(a) * x))                                       \
  DO(sigmoid, logistic<0>(x), logistic<1>(x), logistic<2>(x), logistic<3>(x))                                         \
  DO(tanh, hyperbolic_tangent(x), tangent_slope(x), splat(-2.0f) * hyperbolic_tangent(x) * tangent_slope(x),          \
     tangent_slope(x) * (splat(4.0f) - splat(6.0f) * tangent_slope(x)))                                               \
  DO(silu, x* logistic<0>(x), logistic<0>(x) + x * logistic<1>(x), logistic<1>(x) * splat(2.0f) + x * logistic<2>(x), \
     logistic<2>(x) * splat(3.0f) + x * logistic<3>(x))                                                               \
  DO(gelu, x* distribution(x), distribution(x) + x * density(x), density(x) * (splat(2.0f) - nearby(x) * nearby(x)),  \
     density(x) * nearby(x) * (nearby(x) * nearby(x) - splat(4.0f)))                                                  \
  DO(gelu_tanh, gelu_by_tanh<0>(x), gelu_by_tanh<1>(x), gelu_by_tanh<2>(x), gelu_by_tanh<3>(x))                       \
  DO(sine, any_sine(fma(splat(a), x, splat(b)), false), splat(a) * any_sine(fma(splat(a), x, splat(b)), true),        \
     splat(-a * a) * any_sine(fma(splat(a), x, splat(b)), false),                                                     \
     splat(-a * a * a) * any_sine(fma(splat(a), x, splat(b)), true))                                                  \
  DO(exp, any_exponential(x), any_exponential(x), any_exponential(x), any_exponential(x))                             \
  DO(expm1, x < one ? exponential_minus_one(x) : any_exponential(x) - one, any_exponential(x), any_exponential(x),    \
     any_exponential(x))                                                                                              \
  DO(log1p, logarithm_of_one_plus(x), one / (one + x), zero - one / ((one + x) * (one + x)),                          \
     splat(2.0f) / ((one + x) * (one + x) * (one + x)))                                                               \
  DO(log, logarithm(x), one / x, zero - one / (x * x), splat(2.0f) / (x * x * x))                                     \
  DO(power, raised(x, a, 0), raised(x, a - 1.0f, 1), raised(x, a - 2.0f, 2), raised(x, a - 3.0f, 3))                  \
  DO(erf, error_function(x), splat(2.82842712f) * density(splat(1.41421356f) * x),                                    \
     splat(-5.65685425f) * nearby(x) * density(splat(1.41421356f) * x),                                               \
     splat(5.65685425f) * fma(splat(2.0f) * nearby(x), nearby(x), splat(-1.0f)) * density(splat(1.41421356f) * x))    \
  DO(atan, arctangent(x), arctangent_slope(x), splat(-2.0f) * x * arctangent_slope(x) * arctangent_slope(x),          \
     arctangent_slope(x) * arctangent_slope(x) * fma(splat(-8.0f), arctangent_slope(x), splat(6.0f)))
