// A step reads the whole gradient, and of the other three arrays only the cache lines that have one: most of a large
// table's lines have none. A line is 16 floats, whatever an entry's number of features. Its update has no branches: an
// entry of the line without a gradient is written back as it was. Each operation is rounded on its own (the build has
// contraction off), so that all instruction sets give the same bits.
#include "encoding/sparse_adam_isa.h"

#include "common/simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kLine = 16;

// Any bit but the sign: a gradient of -0 is none, NaN is one.
VN_INLINE bool any(const float* gradient) {
  uint32_t bits[kLine], found = 0;
  __builtin_memcpy(bits, gradient, sizeof(bits));
  for (int i = 0; i < kLine; ++i) found |= bits[i];
  return (found & 0x7fffffffu) != 0;
}

VN_INLINE F32 square_root(F32 a) {
#if VN_ISA == 2
  return _mm512_maskz_sqrt_ps(0xffff, a);
#elif VN_ISA == 1
  return _mm256_sqrt_ps(a);
#else
  for (int i = 0; i < kLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
#endif
}

VN_INLINE F32 load(const float* from) {
  F32 a;
  __builtin_memcpy(&a, from, sizeof(a));
  return a;
}

VN_INLINE void store(float* to, F32 a) {
  __builtin_memcpy(to, &a, sizeof(a));
}

// kLanes entries.
VN_INLINE void update(const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square) {
  const F32 g = load(gradient), p = load(parameter), m = load(mean), v = load(square);
  const auto present = g != F32{};
  const F32 new_m = rule.decay * m + (1.0f - rule.decay) * g;
  const F32 new_v = rule.decay_sq * v + (1.0f - rule.decay_sq) * (g * g);
  const F32 moved = p - rule.step_size * (new_m / (square_root(new_v) / rule.correction + rule.epsilon));
  store(mean, present ? new_m : m);
  store(square, present ? new_v : v);
  store(parameter, present ? moved : p);
}

VN_INLINE void update_line(const SparseAdam& rule, const float* gradient, float* parameter, float* mean,
                           float* square) {
  if (!any(gradient)) return;
  for (int i = 0; i < kLine; i += kLanes) update(rule, gradient + i, parameter + i, mean + i, square + i);
}

}  // namespace

void sparse_adam_block(const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square,
                       int64_t begin, int64_t end) {
  int64_t line = begin;
  for (; line + kLine <= end; line += kLine) {
    update_line(rule, gradient + line, parameter + line, mean + line, square + line);
  }
  if (line == end) return;
  float rest[4][kLine] = {};  // gradient, parameter, mean, square
  const int64_t bytes = (end - line) * static_cast<int64_t>(sizeof(float));
  __builtin_memcpy(rest[0], gradient + line, bytes);
  __builtin_memcpy(rest[1], parameter + line, bytes);
  __builtin_memcpy(rest[2], mean + line, bytes);
  __builtin_memcpy(rest[3], square + line, bytes);
  update_line(rule, rest[0], rest[1], rest[2], rest[3]);
  __builtin_memcpy(parameter + line, rest[1], bytes);
  __builtin_memcpy(mean + line, rest[2], bytes);
  __builtin_memcpy(square + line, rest[3], bytes);
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
