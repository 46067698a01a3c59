// Operands of bfloat16 products, made from float32 rows. Two values share 32 bits, so a pair is handled as one float by
// what only moves data: blocks broadcast it, panels are laid out by it (gemm_tile.h). Along k, what a pair joins is
// neighbouring columns of a row (`narrow_row`), or neighbouring rows of a column (`interleave`) where the samples are
// k.
#pragma once

#include "common/memory_tile.h"

#if VN_HALF

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

#if VN_ISA == 2

// The first `count` <= 16 floats, then zeros; negative counts are 0.
VN_INLINE F32 load_some(const float* from, int64_t count) {
  const unsigned mask = count >= kLanes ? 0xffffu : count <= 0 ? 0u : (1u << count) - 1u;
  return _mm512_maskz_loadu_ps(static_cast<__mmask16>(mask), from);
}

VN_INLINE F32 joined(F32 low, F32 high) { return (F32)_mm512_cvtne2ps_pbh(high, low); }

// Pairs (even[i], odd[i]).
VN_INLINE F32 interleave(F32 even, F32 odd) {
  const __m512i order = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8, 23, 7, 22, 6, 21,
                                         5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
  return (F32)_mm512_maskz_permutexvar_epi16(0xffffffffu, order, (__m512i)joined(even, odd));
}

// One half of what was joined: the first values, or those behind them.
VN_INLINE F32 widened(F32 pairs, int half) {
  const __m256i values =
      half == 0 ? _mm512_castsi512_si256((__m512i)pairs) : _mm512_maskz_extracti64x4_epi64(0xf, (__m512i)pairs, 1);
  return (F32)_mm512_maskz_slli_epi32(0xffff, _mm512_maskz_cvtepu16_epi32(0xffff, values), 16);
}

// Pairs of the values of two that were joined: of the first ones, and of those behind them.
VN_INLINE void zip_halves(F32 even, F32 odd, F32& low, F32& high) {
  const __m512i first = _mm512_set_epi16(47, 15, 46, 14, 45, 13, 44, 12, 43, 11, 42, 10, 41, 9, 40, 8, 39, 7, 38, 6, 37,
                                         5, 36, 4, 35, 3, 34, 2, 33, 1, 32, 0);
  const __m512i second = _mm512_add_epi16(first, _mm512_set1_epi16(16));
  low = (F32)_mm512_permutex2var_epi16((__m512i)even, first, (__m512i)odd);
  high = (F32)_mm512_permutex2var_epi16((__m512i)even, second, (__m512i)odd);
}

#else

// To the nearest, ties to even; NaN stays NaN.
VN_INLINE uint32_t rounded(float value) {
  uint32_t bits;
  __builtin_memcpy(&bits, &value, sizeof bits);
  if ((bits & 0x7fffffffu) > 0x7f800000u) return bits >> 16 | 0x40u;
  return (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
}

VN_INLINE F32 load_some(const float* from, int64_t count) {
  float some[kLanes] = {};
  for (int i = 0; i < kLanes && i < count; ++i) some[i] = from[i];
  return load(some);
}

VN_INLINE F32 joined(F32 low, F32 high) {
  uint32_t pairs[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const F32 half = 2 * i < kLanes ? low : high;
    pairs[i] = rounded(half[2 * i % kLanes]) | rounded(half[2 * i % kLanes + 1]) << 16;
  }
  F32 made;
  __builtin_memcpy(&made, pairs, sizeof made);
  return made;
}

VN_INLINE F32 interleave(F32 even, F32 odd) {
  uint32_t pairs[kLanes];
  for (int i = 0; i < kLanes; ++i) pairs[i] = rounded(even[i]) | rounded(odd[i]) << 16;
  F32 made;
  __builtin_memcpy(&made, pairs, sizeof made);
  return made;
}

VN_INLINE F32 widened(F32 pairs, int half) {
  uint16_t values[2 * kLanes];
  __builtin_memcpy(values, &pairs, sizeof pairs);
  uint32_t bits[kLanes];
  for (int i = 0; i < kLanes; ++i) bits[i] = static_cast<uint32_t>(values[half * kLanes + i]) << 16;
  F32 made;
  __builtin_memcpy(&made, bits, sizeof made);
  return made;
}

#endif

// The first and the second value of each pair.
VN_INLINE F32 lower_of(F32 pairs) {
  I32 bits;
  __builtin_memcpy(&bits, &pairs, sizeof bits);
#if VN_ISA == 2
  return (F32)_mm512_maskz_slli_epi32(0xffff, bits, 16);
#else
  bits = bits << 16;
  __builtin_memcpy(&pairs, &bits, sizeof bits);
  return pairs;
#endif
}
VN_INLINE F32 upper_of(F32 pairs) {
  I32 bits;
  __builtin_memcpy(&bits, &pairs, sizeof bits);
#if VN_ISA == 2
  return (F32)_mm512_and_si512(bits, _mm512_set1_epi32(static_cast<int32_t>(0xffff0000)));
#else
  bits = bits & splat(static_cast<int32_t>(0xffff0000));
  __builtin_memcpy(&pairs, &bits, sizeof bits);
  return pairs;
#endif
}

// What rounding to pairs has left of two vectors, as pairs.
VN_INLINE F32 left_of(F32 low, F32 high, F32 pairs) {
  return joined(low - widened(pairs, 0), high - widened(pairs, 1));
}

// `width` floats -> pairs, the last filled up with 0. Whole vectors are written: 16 pairs at a time.
// `left`: in this place, if not null, what rounding has left.
VN_INLINE void narrow_row(const float* from, int64_t width, float* to, float* left = nullptr) {
  for (int64_t i = 0; i < width; i += 32) {
    for (int64_t v = i; v < i + 32; v += 2 * kLanes) {
      const F32 low = load_some(from + v, width - v), high = load_some(from + v + kLanes, width - v - kLanes);
      const F32 pairs = joined(low, high);
      store(to + v / 2, pairs);
      if (left != nullptr) store(left + v / 2, left_of(low, high, pairs));
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#endif
