// Operands of bfloat16 products, made from float32 rows. A pair of two values has 32 bits, so code that only moves data
// treats it as one float: blocks broadcast it, and panels are laid out in pairs (gemm_tile.h). A pair joins two
// neighbours along k, the inner dimension of the product: two columns of a row (`narrow_row`) or, if k runs over the
// samples, two rows of a column (`interleave`).
#pragma once

#include "common/memory_tile.h"

#if VN_HALF

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

#if VN_ISA == 2

// Loads the first `count` floats (0 to 16) and pads with zeros. A negative count counts as 0.
VN_INLINE F32 load_some(const float* from, int64_t count) {
  const unsigned mask = count >= kLanes ? 0xffffu : count <= 0 ? 0u : (1u << count) - 1u;
  return _mm512_maskz_loadu_ps(static_cast<__mmask16>(mask), from);
}

VN_INLINE F32 joined(F32 low, F32 high) { return (F32)_mm512_cvtne2ps_pbh(high, low); }

// Returns the pairs (even[i], odd[i]).
VN_INLINE F32 interleave(F32 even, F32 odd) {
  const __m512i order = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8, 23, 7, 22, 6, 21,
                                         5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
  return (F32)_mm512_maskz_permutexvar_epi16(0xffffffffu, order, (__m512i)joined(even, odd));
}

// Returns one of two joined vectors as floats: the first (half 0) or the second (half 1).
VN_INLINE F32 widened(F32 pairs, int half) {
  __m256i values = _mm512_maskz_extracti64x4_epi64(0xf, (__m512i)pairs, 1);
  if (half == 0) __builtin_memcpy(&values, &pairs, sizeof values);  // the cast warns in gcc 12 (simd.h)
  return (F32)_mm512_maskz_slli_epi32(0xffff, _mm512_maskz_cvtepu16_epi32(0xffff, values), 16);
}

// Zips the values of two joined vectors to pairs: `low` gets the pairs of the first halves, `high` the pairs of the
// second halves.
VN_INLINE void zip_halves(F32 even, F32 odd, F32& low, F32& high) {
  const __m512i first = _mm512_set_epi16(47, 15, 46, 14, 45, 13, 44, 12, 43, 11, 42, 10, 41, 9, 40, 8, 39, 7, 38, 6, 37,
                                         5, 36, 4, 35, 3, 34, 2, 33, 1, 32, 0);
  const __m512i second = _mm512_add_epi16(first, _mm512_set1_epi16(16));
  low = (F32)_mm512_permutex2var_epi16((__m512i)even, first, (__m512i)odd);
  high = (F32)_mm512_permutex2var_epi16((__m512i)even, second, (__m512i)odd);
}

#else

// Rounds to the nearest bfloat16, ties to even; NaN stays NaN.
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
  F32 result;
  __builtin_memcpy(&result, pairs, sizeof result);
  return result;
}

VN_INLINE F32 interleave(F32 even, F32 odd) {
  uint32_t pairs[kLanes];
  for (int i = 0; i < kLanes; ++i) pairs[i] = rounded(even[i]) | rounded(odd[i]) << 16;
  F32 result;
  __builtin_memcpy(&result, pairs, sizeof result);
  return result;
}

VN_INLINE F32 widened(F32 pairs, int half) {
  uint16_t values[2 * kLanes];
  __builtin_memcpy(values, &pairs, sizeof pairs);
  uint32_t bits[kLanes];
  for (int i = 0; i < kLanes; ++i) bits[i] = static_cast<uint32_t>(values[half * kLanes + i]) << 16;
  F32 result;
  __builtin_memcpy(&result, bits, sizeof result);
  return result;
}

#endif

// lower_of and upper_of return the first and the second value of each pair as floats.
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

// Returns the rounding remainders of two vectors that were joined to `pairs`, as pairs.
VN_INLINE F32 left_of(F32 low, F32 high, F32 pairs) {
  return joined(low - widened(pairs, 0), high - widened(pairs, 1));
}

// Rounds `width` floats to pairs and pads with 0 to a multiple of 16 pairs. If `left` is not null, the rounding
// remainders are stored there as pairs.
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
