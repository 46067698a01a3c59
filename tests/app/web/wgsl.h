// The WGSL types and functions that a page's shaders use, in C++. wgsl.py translates the shaders' text.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

namespace wgsl {

using u32 = uint32_t;
using i32 = int32_t;
using f32 = float;

template <class T, int N>
struct vec {
  T values[N] = {};

  vec() = default;
  // Concatenates numbers and vectors, N numbers in all, or repeats one number N times.
  template <class... Parts>
  explicit vec(const Parts&... parts) {
    constexpr bool kSplat = sizeof...(parts) == 1 && (std::is_arithmetic_v<Parts> && ...);
    int count = 0;
    for (int i = 0; i < (kSplat ? N : 1); ++i) (put(count, parts), ...);
  }
  template <class U>
  void put(int& count, U number) {
    values[count++] = static_cast<T>(number);
  }
  template <class U, int M>
  void put(int& count, const vec<U, M>& part) {
    for (const U number : part.values) put(count, number);
  }
  T& operator[](u32 i) { return values[i]; }
  const T& operator[](u32 i) const { return values[i]; }
  template <int... I>
  vec<T, sizeof...(I)> lanes() const {
    return vec<T, sizeof...(I)>(values[I]...);
  }
};
using vec2f = vec<f32, 2>;
using vec3f = vec<f32, 3>;
using vec4f = vec<f32, 4>;
using vec2u = vec<u32, 2>;
using vec3u = vec<u32, 3>;
using vec4u = vec<u32, 4>;
template <class T, u32 N>
using array = std::array<T, N>;

// Returns lane i of a vector; a number has the same value in all lanes.
template <class T, int N>
T lane(const vec<T, N>& x, int i) {
  return x[i];
}
template <class T>
T lane(T x, int) {
  return x;
}
// The number of lanes of the first vector among the arguments; 0 if all are numbers.
template <class... X>
constexpr int lanes_of = 0;
template <class T, int N, class... X>
constexpr int lanes_of<vec<T, N>, X...> = N;
template <class T, class... X>
constexpr int lanes_of<T, X...> = lanes_of<X...>;
// Applies f to each lane.
template <class F, class... X>
auto each(F f, const X&... x) {
  constexpr int kLanes = lanes_of<X...>;
  if constexpr (kLanes == 0) {
    return f(x...);
  } else {
    vec<decltype(f(lane(x, 0)...)), kLanes> result;
    for (int i = 0; i < kLanes; ++i) result[i] = f(lane(x, i)...);
    return result;
  }
}

#define OPERATOR(OP)                                                        \
  template <class A, class B, class = std::enable_if_t<0 < lanes_of<A, B>>> \
  auto operator OP(const A& a, const B& b) {                                \
    return each([](auto x, auto y) { return x OP y; }, a, b);               \
  }
OPERATOR(+);
OPERATOR(-);
OPERATOR(*);
OPERATOR(/);
OPERATOR(<);
OPERATOR(>);
OPERATOR(<=);
OPERATOR(>=);
OPERATOR(==);
#undef OPERATOR
template <class T, int N, class B>
void operator+=(vec<T, N>& a, const B& b) {
  a = a + b;
}
template <class T, int N, class B>
void operator/=(vec<T, N>& a, const B& b) {
  a = a / b;
}
template <class T, int N>
auto operator-(const vec<T, N>& a) {
  return T(0) - a;
}

#define FUNCTION(NAME, ARGUMENTS, ...)                       \
  template <class... X>                                      \
  auto NAME(const X&... x) {                                 \
    return each([] ARGUMENTS { return __VA_ARGS__; }, x...); \
  }
FUNCTION(abs, (f32 x), std::fabs(x));
FUNCTION(exp, (f32 x), std::exp(x));
FUNCTION(exp2, (f32 x), std::exp2(x));
FUNCTION(log, (f32 x), std::log(x));
FUNCTION(sin, (f32 x), std::sin(x));
FUNCTION(cos, (f32 x), std::cos(x));
FUNCTION(tanh, (f32 x), std::tanh(x));
FUNCTION(round, (f32 x), std::nearbyint(x));
FUNCTION(min, (auto x, decltype(x) y), y < x ? y : x);
FUNCTION(max, (auto x, decltype(x) y), x < y ? y : x);
FUNCTION(select, (auto no, decltype(no) yes, bool condition), condition ? yes : no);
FUNCTION(mix, (f32 x, f32 y, f32 share), x * (1 - share) + y * share);
#undef FUNCTION
template <class X, class Y, class Z>
auto clamp(const X& x, const Y& low, const Z& high) {
  return min(max(x, low), high);
}

template <int N>
f32 dot(const vec<f32, N>& a, const vec<f32, N>& b) {
  f32 sum = 0;
  for (int i = 0; i < N; ++i) sum += a[i] * b[i];
  return sum;
}
template <int N>
f32 length(const vec<f32, N>& x) {
  return std::sqrt(dot(x, x));
}
template <int N>
auto normalize(const vec<f32, N>& x) {
  return x / length(x);
}
template <int N>
bool all(const vec<bool, N>& x) {
  for (const bool each : x.values)
    if (!each) return false;
  return true;
}

struct mat4x4f {
  vec4f columns[4];
  mat4x4f(vec4f a, vec4f b, vec4f c, vec4f d) : columns{a, b, c, d} {}
};
inline vec4f operator*(const mat4x4f& m, const vec4f& x) {
  return m.columns[0] * x[0] + m.columns[1] * x[1] + m.columns[2] * x[2] + m.columns[3] * x[3];
}

template <class To, class From>
To bitcast(From x) {
  To result;
  static_assert(sizeof result == sizeof x);
  std::memcpy(&result, &x, sizeof x);
  return result;
}
inline u32 pack2x16float(const vec2f& x) {
  const auto bits = [](f32 value) { return u32{bitcast<uint16_t>(static_cast<_Float16>(value))}; };
  return bits(x[0]) | bits(x[1]) << 16;
}
inline vec2f unpack2x16float(u32 x) {
  return vec2f(bitcast<_Float16>(static_cast<uint16_t>(x)), bitcast<_Float16>(static_cast<uint16_t>(x >> 16)));
}
inline vec4f unpack4x8unorm(u32 x) { return vec4f(x & 255, x >> 8 & 255, x >> 16 & 255, x >> 24) / 255.0f; }

}  // namespace wgsl
