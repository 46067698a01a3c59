// A step reads the whole gradient, but in the other three arrays only cache lines with a nonzero gradient: in a large
// table most lines have none. A line is 16 floats. Its update has no branches, and entries with zero gradient are
// written back unchanged. A rule with `dense` streams through all arrays, which the hardware prefetches. Each operation
// is rounded separately (the build turns contraction off), so that all instruction sets give the same bits.
#include "encoding/adam_isa.h"

#include "common/memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kLine = 16;
constexpr int kLines = 256;  // lines per pass: listing their nonzero lines first avoids mispredicted branches
constexpr int kAhead = 8;    // lines to prefetch ahead

// Returns whether a line has a nonzero gradient: any bit but the sign, so that -0 counts as zero and NaN does not.
VN_INLINE int is_nonzero(const float* gradient) {
#if VN_ISA == 2
  return _mm512_test_epi32_mask(_mm512_loadu_si512(gradient), _mm512_set1_epi32(0x7fffffff)) != 0;
#elif VN_ISA == 1
  const __m256i a = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(gradient));
  const __m256i b = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(gradient + 8));
  return !_mm256_testz_si256(_mm256_or_si256(a, b), _mm256_set1_epi32(0x7fffffff));
#else
  uint32_t bits[kLine], found = 0;
  __builtin_memcpy(bits, gradient, sizeof(bits));
  for (int i = 0; i < kLine; ++i) found |= bits[i];
  return (found & 0x7fffffffu) != 0;
#endif
}

// Updates kLanes entries.
VN_INLINE void update(const AdamStep& rule, const float* gradient, float* parameter, float* mean, float* square) {
  const F32 g = load(gradient), p = load(parameter), m = load(mean), v = load(square);
  const auto present = (g != F32{}) | (rule.dense ? -1 : 0);
  const F32 new_m = rule.decay * m + rule.fresh * g;
  const F32 new_v = rule.decay_sq * v + rule.fresh_sq * (g * g);
  const F32 moved = p - rule.step_size * (new_m / (square_root(new_v) + rule.epsilon));
  store(mean, present ? new_m : m);
  store(square, present ? new_v : v);
  store(parameter, present ? moved : p);
}

}  // namespace

void adam_block(const AdamStep& rule, const float* gradient, float* parameter, float* mean, float* square,
                int64_t begin, int64_t end) {
  int64_t line = begin;
  for (; rule.dense && line + kLine <= end; line += kLine) {
    for (int j = 0; j < kLine; j += kLanes) {
      update(rule, gradient + line + j, parameter + line + j, mean + line + j, square + line + j);
    }
  }
  int32_t nonzero[kLines];
  while (line + kLine <= end) {
    const int64_t lines = (end - line) / kLine < kLines ? (end - line) / kLine : kLines;
    int count = 0;
    for (int64_t i = 0; i < lines; ++i) {
      nonzero[count] = static_cast<int32_t>(i * kLine);
      count += is_nonzero(gradient + line + i * kLine);
    }
    for (int i = 0; i < count; ++i) {
      if (i + kAhead < count) {
        const int64_t later = line + nonzero[i + kAhead];
        __builtin_prefetch(parameter + later, 1);
        __builtin_prefetch(mean + later, 1);
        __builtin_prefetch(square + later, 1);
      }
      const int64_t at = line + nonzero[i];
      for (int j = 0; j < kLine; j += kLanes) {
        update(rule, gradient + at + j, parameter + at + j, mean + at + j, square + at + j);
      }
    }
    line += lines * kLine;
  }
  if (line == end) return;
  float rest[4][kLine] = {};  // gradient, parameter, mean, square
  const int64_t bytes = (end - line) * static_cast<int64_t>(sizeof(float));
  __builtin_memcpy(rest[0], gradient + line, bytes);
  __builtin_memcpy(rest[1], parameter + line, bytes);
  __builtin_memcpy(rest[2], mean + line, bytes);
  __builtin_memcpy(rest[3], square + line, bytes);
  for (int j = 0; j < kLine; j += kLanes) update(rule, rest[0] + j, rest[1] + j, rest[2] + j, rest[3] + j);
  __builtin_memcpy(parameter + line, rest[1], bytes);
  __builtin_memcpy(mean + line, rest[2], bytes);
  __builtin_memcpy(square + line, rest[3], bytes);
}

bool adam_all_below(float limit, const float* gradient, int64_t n) {
  int beyond = 0;
  for (int64_t i = 0; i < n; ++i) beyond |= !(__builtin_fabsf(gradient[i]) < limit);  // true for NaN
  return beyond == 0;
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
