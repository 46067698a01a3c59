// Vectors of int32: arithmetic, table look-ups (gather), and the bits of a float as an integer. Non-negative floats are
// ordered like their bits.
#pragma once

#include "common/simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

#if VN_ISA == 1 || VN_ISA == 2

VN_INLINE int32_t smallest_of_eight(__m256i a) {
  __m128i b = _mm_min_epi32(_mm256_castsi256_si128(a), _mm256_extracti128_si256(a, 1));
  b = _mm_min_epi32(b, _mm_shuffle_epi32(b, 0x4e));
  return _mm_cvtsi128_si32(_mm_min_epi32(b, _mm_shuffle_epi32(b, 0xb1)));
}

#endif

#if VN_ISA == 2

VN_INLINE I32 as_integer(F32 a) { return _mm512_castps_si512(a); }
VN_INLINE F32 as_float(I32 a) { return _mm512_castsi512_ps(a); }
VN_INLINE I32 add(I32 a, I32 b) { return _mm512_add_epi32(a, b); }
VN_INLINE I32 both(I32 a, I32 b) { return _mm512_and_si512(a, b); }
VN_INLINE I32 min(I32 a, I32 b) { return _mm512_maskz_min_epi32(0xffff, a, b); }
VN_INLINE I32 max(I32 a, I32 b) { return _mm512_maskz_max_epi32(0xffff, a, b); }
// Returns (a & mask) | b.
VN_INLINE I32 tag(I32 a, I32 mask, I32 b) { return _mm512_ternarylogic_epi32(a, mask, b, 0xea); }
VN_INLINE I32 subtract(I32 a, I32 b) { return _mm512_sub_epi32(a, b); }
VN_INLINE I32 left(I32 a, int bits) { return _mm512_maskz_sll_epi32(0xffff, a, _mm_cvtsi32_si128(bits)); }
VN_INLINE I32 right(I32 a, int bits) { return _mm512_maskz_srl_epi32(0xffff, a, _mm_cvtsi32_si128(bits)); }
VN_INLINE Mask less(I32 a, I32 b) { return _mm512_cmplt_epi32_mask(a, b); }
VN_INLINE F32 divide(F32 a, F32 b) { return _mm512_div_ps(a, b); }
VN_INLINE int32_t smallest(I32 a) {
  const __m256i half =
      _mm256_min_epi32(_mm512_maskz_extracti64x4_epi64(0xf, a, 0), _mm512_maskz_extracti64x4_epi64(0xf, a, 1));
  return smallest_of_eight(half);
}
// Rounds towards zero. The number must fit an int32.
VN_INLINE I32 truncate(F32 a) { return _mm512_maskz_cvttps_epi32(0xffff, a); }
VN_INLINE I32 gather(const int32_t* table, I32 rows) {
  return _mm512_mask_i32gather_epi32(_mm512_setzero_si512(), 0xffff, rows, table, 4);
}
VN_INLINE F32 gather(const float* table, I32 rows) {
  return _mm512_mask_i32gather_ps(_mm512_setzero_ps(), 0xffff, rows, table, 4);
}

#elif VN_ISA == 1

VN_INLINE I32 as_integer(F32 a) { return _mm256_castps_si256(a); }
VN_INLINE F32 as_float(I32 a) { return _mm256_castsi256_ps(a); }
VN_INLINE I32 add(I32 a, I32 b) { return _mm256_add_epi32(a, b); }
VN_INLINE I32 both(I32 a, I32 b) { return _mm256_and_si256(a, b); }
VN_INLINE I32 min(I32 a, I32 b) { return _mm256_min_epi32(a, b); }
VN_INLINE I32 max(I32 a, I32 b) { return _mm256_max_epi32(a, b); }
VN_INLINE I32 tag(I32 a, I32 mask, I32 b) { return _mm256_or_si256(_mm256_and_si256(a, mask), b); }
VN_INLINE I32 subtract(I32 a, I32 b) { return _mm256_sub_epi32(a, b); }
VN_INLINE I32 left(I32 a, int bits) { return _mm256_sll_epi32(a, _mm_cvtsi32_si128(bits)); }
VN_INLINE I32 right(I32 a, int bits) { return _mm256_srl_epi32(a, _mm_cvtsi32_si128(bits)); }
VN_INLINE Mask less(I32 a, I32 b) { return _mm256_castsi256_ps(_mm256_cmpgt_epi32(b, a)); }
VN_INLINE F32 divide(F32 a, F32 b) { return _mm256_div_ps(a, b); }
VN_INLINE int32_t smallest(I32 a) { return smallest_of_eight(a); }
VN_INLINE I32 truncate(F32 a) { return _mm256_cvttps_epi32(a); }
VN_INLINE I32 gather(const int32_t* table, I32 rows) { return _mm256_i32gather_epi32(table, rows, 4); }
VN_INLINE F32 gather(const float* table, I32 rows) { return _mm256_i32gather_ps(table, rows, 4); }

#else

VN_INLINE I32 as_integer(F32 a) { return reinterpret_cast<I32>(a); }
VN_INLINE F32 as_float(I32 a) { return reinterpret_cast<F32>(a); }
VN_INLINE I32 add(I32 a, I32 b) { return a + b; }
VN_INLINE I32 both(I32 a, I32 b) { return a & b; }
VN_INLINE I32 min(I32 a, I32 b) { return a < b ? a : b; }
VN_INLINE I32 max(I32 a, I32 b) { return a > b ? a : b; }
VN_INLINE I32 tag(I32 a, I32 mask, I32 b) { return (a & mask) | b; }
VN_INLINE I32 subtract(I32 a, I32 b) { return a - b; }
VN_INLINE I32 left(I32 a, int bits) { return a << bits; }
// Shifts right; the numbers must not be negative.
VN_INLINE I32 right(I32 a, int bits) { return a >> bits; }
VN_INLINE Mask less(I32 a, I32 b) { return a < b; }
VN_INLINE F32 divide(F32 a, F32 b) { return a / b; }
VN_INLINE int32_t smallest(I32 a) {
  const int32_t low = a[0] < a[1] ? a[0] : a[1], high = a[2] < a[3] ? a[2] : a[3];
  return low < high ? low : high;
}
VN_INLINE I32 truncate(F32 a) { return __builtin_convertvector(a, I32); }
VN_INLINE I32 gather(const int32_t* table, I32 rows) {
  return I32{table[rows[0]], table[rows[1]], table[rows[2]], table[rows[3]]};
}
VN_INLINE F32 gather(const float* table, I32 rows) {
  return F32{table[rows[0]], table[rows[1]], table[rows[2]], table[rows[3]]};
}

#endif

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
