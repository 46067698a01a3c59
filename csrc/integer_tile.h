// Vectors of int32: arithmetic, look-ups in tables, and the view of a float's bits as a number. Floats that are not
// negative are in the order of their bits.
#pragma once

#include "simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

#if VN_ISA == 2

VN_INLINE I32 as_integer(F32 a) {
  return _mm512_castps_si512(a);
}
VN_INLINE F32 as_float(I32 a) {
  return _mm512_castsi512_ps(a);
}
VN_INLINE I32 add(I32 a, I32 b) {
  return _mm512_add_epi32(a, b);
}
VN_INLINE I32 both(I32 a, I32 b) {
  return _mm512_and_si512(a, b);
}
VN_INLINE I32 min(I32 a, I32 b) {
  return _mm512_maskz_min_epi32(0xffff, a, b);
}
VN_INLINE I32 max(I32 a, I32 b) {
  return _mm512_maskz_max_epi32(0xffff, a, b);
}
// (a & mask) | b
VN_INLINE I32 tag(I32 a, I32 mask, I32 b) {
  return _mm512_ternarylogic_epi32(a, mask, b, 0xea);
}

#elif VN_ISA == 1

VN_INLINE I32 as_integer(F32 a) {
  return _mm256_castps_si256(a);
}
VN_INLINE F32 as_float(I32 a) {
  return _mm256_castsi256_ps(a);
}
VN_INLINE I32 add(I32 a, I32 b) {
  return _mm256_add_epi32(a, b);
}
VN_INLINE I32 both(I32 a, I32 b) {
  return _mm256_and_si256(a, b);
}
VN_INLINE I32 min(I32 a, I32 b) {
  return _mm256_min_epi32(a, b);
}
VN_INLINE I32 max(I32 a, I32 b) {
  return _mm256_max_epi32(a, b);
}
VN_INLINE I32 tag(I32 a, I32 mask, I32 b) {
  return _mm256_or_si256(_mm256_and_si256(a, mask), b);
}

#else

VN_INLINE I32 as_integer(F32 a) {
  return reinterpret_cast<I32>(a);
}
VN_INLINE F32 as_float(I32 a) {
  return reinterpret_cast<F32>(a);
}
VN_INLINE I32 add(I32 a, I32 b) {
  return a + b;
}
VN_INLINE I32 both(I32 a, I32 b) {
  return a & b;
}
VN_INLINE I32 min(I32 a, I32 b) {
  return a < b ? a : b;
}
VN_INLINE I32 max(I32 a, I32 b) {
  return a > b ? a : b;
}
VN_INLINE I32 tag(I32 a, I32 mask, I32 b) {
  return (a & mask) | b;
}

#endif

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
