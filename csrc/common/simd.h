// A vector of float32 and the operations that the kernels need, for the instruction set of the including file (VN_ISA:
// 0 portable, 1 AVX2 + FMA, 2 AVX-512, 3 NEON; see isa.h). kLanes is the number of lanes of a vector, kRegisters the
// number of vector registers.
//
// Everything here has internal linkage. A file compiled for AVX-512 must not emit an inline function that the linker
// could pick for a processor without AVX-512. So *_isa.cpp files include no standard headers except <cstdint> and
// <cstddef>.
#pragma once

#include <cstddef>
#include <cstdint>

#ifndef VN_ISA
#error "compile with VN_ISA=0, 1, 2 or 3"
#endif

#if VN_ISA == 2
#include <immintrin.h>
#define VN_ISA_NAMESPACE avx512
#elif VN_ISA == 1
#include <immintrin.h>
#define VN_ISA_NAMESPACE avx2
#elif VN_ISA == 3
#include <arm_neon.h>
#define VN_ISA_NAMESPACE neon
#else
#define VN_ISA_NAMESPACE portable
#endif

#define VN_INLINE static inline __attribute__((always_inline, unused))

namespace voronerf {
namespace VN_ISA_NAMESPACE {

#if VN_ISA == 2

constexpr int kLanes = 16, kRegisters = 32;
using F32 = __m512;
using I32 = __m512i;
using Mask = __mmask16;

VN_INLINE F32 splat(float a) { return _mm512_set1_ps(a); }
VN_INLINE I32 splat(int32_t a) { return _mm512_set1_epi32(a); }
VN_INLINE F32 sub(F32 a, F32 b) { return _mm512_sub_ps(a, b); }
VN_INLINE F32 mul(F32 a, F32 b) { return _mm512_mul_ps(a, b); }
VN_INLINE F32 add(F32 a, F32 b) { return _mm512_add_ps(a, b); }
VN_INLINE F32 fma(F32 a, F32 b, F32 c) { return _mm512_fmadd_ps(a, b, c); }
// The full mask gives the plain instructions. The unmasked intrinsics of gcc 12 cause warnings about an uninitialised
// operand (gcc bug 105593).
VN_INLINE F32 min(F32 a, F32 b) { return _mm512_maskz_min_ps(0xffff, a, b); }
VN_INLINE F32 max(F32 a, F32 b) { return _mm512_maskz_max_ps(0xffff, a, b); }
VN_INLINE F32 abs(F32 a) { return _mm512_abs_ps(a); }
VN_INLINE F32 square_root(F32 a) { return _mm512_maskz_sqrt_ps(0xffff, a); }
VN_INLINE Mask less(F32 a, F32 b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
VN_INLINE I32 select(Mask m, I32 a, I32 b) { return _mm512_mask_mov_epi32(b, m, a); }
VN_INLINE unsigned bits(Mask m) { return m; }
VN_INLINE void store(int32_t* to, I32 a) { _mm512_storeu_si512(to, a); }

// Loads sixteen points [16,3] as vectors of their three coordinates.
VN_INLINE void load_points(const float* p, F32& x, F32& y, F32& z) {
  const F32 a = _mm512_loadu_ps(p), b = _mm512_loadu_ps(p + 16), c = _mm512_loadu_ps(p + 32);
  // Lanes 0-10 of x and y, and lanes 0-9 of z, come from a and b, the other lanes from c. Index 16 + i selects lane i
  // of the second operand.
  const I32 x_ab = _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
  const I32 y_ab = _mm512_setr_epi32(1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
  const I32 z_ab = _mm512_setr_epi32(2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
  const I32 x_c = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
  const I32 y_c = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
  const I32 z_c = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);
  x = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, x_ab, b), x_c, c);
  y = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, y_ab, b), y_c, c);
  z = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, z_ab, b), z_c, c);
}

// Interleaves the lanes of a and b: a[0], b[0], a[1], b[1], ... The first half of the result is `low`, the second half
// `high`.
VN_INLINE void zip(F32 a, F32 b, F32& low, F32& high) {
  const I32 first = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
  const I32 second = _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
  low = _mm512_permutex2var_ps(a, first, b);
  high = _mm512_permutex2var_ps(a, second, b);
}

// Returns a vector whose lane i is the sum of v[i]'s lanes. All sums use the same order.
VN_INLINE F32 lane_sums(const F32* v) {
  F32 four[4];  // lane 4 j + i of four[g]: the sum of the j-th quarter of v[4 g + i]
  for (int g = 0; g < 4; ++g) {
    const F32 *a = v + 4 * g,
              ab = add(_mm512_maskz_unpacklo_ps(0xffff, a[0], a[1]), _mm512_maskz_unpackhi_ps(0xffff, a[0], a[1]));
    const F32 cd = add(_mm512_maskz_unpacklo_ps(0xffff, a[2], a[3]), _mm512_maskz_unpackhi_ps(0xffff, a[2], a[3]));
    const __m512d low = _mm512_maskz_unpacklo_pd(0xff, _mm512_castps_pd(ab), _mm512_castps_pd(cd));
    const __m512d high = _mm512_maskz_unpackhi_pd(0xff, _mm512_castps_pd(ab), _mm512_castps_pd(cd));
    four[g] = add(_mm512_castpd_ps(low), _mm512_castpd_ps(high));
  }
  const auto halves = [](F32 a, F32 b) {
    return add(_mm512_maskz_shuffle_f32x4(0xffff, a, b, 0x88), _mm512_maskz_shuffle_f32x4(0xffff, a, b, 0xdd));
  };
  return halves(halves(four[0], four[1]), halves(four[2], four[3]));
}

#elif VN_ISA == 1

constexpr int kLanes = 8, kRegisters = 16;
using F32 = __m256;
using I32 = __m256i;
using Mask = __m256;

VN_INLINE F32 splat(float a) { return _mm256_set1_ps(a); }
VN_INLINE I32 splat(int32_t a) { return _mm256_set1_epi32(a); }
VN_INLINE F32 sub(F32 a, F32 b) { return _mm256_sub_ps(a, b); }
VN_INLINE F32 mul(F32 a, F32 b) { return _mm256_mul_ps(a, b); }
VN_INLINE F32 add(F32 a, F32 b) { return _mm256_add_ps(a, b); }
VN_INLINE F32 fma(F32 a, F32 b, F32 c) { return _mm256_fmadd_ps(a, b, c); }
VN_INLINE F32 min(F32 a, F32 b) { return _mm256_min_ps(a, b); }
VN_INLINE F32 max(F32 a, F32 b) { return _mm256_max_ps(a, b); }
VN_INLINE F32 abs(F32 a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), a); }
VN_INLINE F32 square_root(F32 a) { return _mm256_sqrt_ps(a); }
VN_INLINE Mask less(F32 a, F32 b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }
VN_INLINE I32 select(Mask m, I32 a, I32 b) { return _mm256_blendv_epi8(b, a, _mm256_castps_si256(m)); }
VN_INLINE unsigned bits(Mask m) { return static_cast<unsigned>(_mm256_movemask_ps(m)); }
VN_INLINE void store(int32_t* to, I32 a) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), a); }

VN_INLINE void zip(F32 a, F32 b, F32& low, F32& high) {
  const F32 even = _mm256_unpacklo_ps(a, b), odd = _mm256_unpackhi_ps(a, b);
  low = _mm256_permute2f128_ps(even, odd, 0x20);
  high = _mm256_permute2f128_ps(even, odd, 0x31);
}

VN_INLINE F32 lane_sums(const F32* v) {
  F32 two[2];
  for (int g = 0; g < 2; ++g) {
    const F32* a = v + 4 * g;
    const F32 ab = add(_mm256_unpacklo_ps(a[0], a[1]), _mm256_unpackhi_ps(a[0], a[1]));
    const F32 cd = add(_mm256_unpacklo_ps(a[2], a[3]), _mm256_unpackhi_ps(a[2], a[3]));
    const __m256d low = _mm256_unpacklo_pd(_mm256_castps_pd(ab), _mm256_castps_pd(cd));
    const __m256d high = _mm256_unpackhi_pd(_mm256_castps_pd(ab), _mm256_castps_pd(cd));
    two[g] = add(_mm256_castpd_ps(low), _mm256_castpd_ps(high));
  }
  return add(_mm256_permute2f128_ps(two[0], two[1], 0x20), _mm256_permute2f128_ps(two[0], two[1], 0x31));
}

VN_INLINE __m256 load_halves(const float* low, const float* high) {
  return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high), 1);
}

// Loads eight points [8,3] as vectors of their three coordinates. The shuffles process points 0-3 and 4-7 side by side.
VN_INLINE void load_points(const float* p, F32& x, F32& y, F32& z) {
  const __m256 a = load_halves(p, p + 12);                             // x0 y0 z0 x1
  const __m256 b = load_halves(p + 4, p + 16);                         // y1 z1 x2 y2
  const __m256 c = load_halves(p + 8, p + 20);                         // z2 x3 y3 z3
  const __m256 xy = _mm256_shuffle_ps(b, c, _MM_SHUFFLE(2, 1, 3, 2));  // x2 y2 x3 y3
  const __m256 yz = _mm256_shuffle_ps(a, b, _MM_SHUFFLE(1, 0, 2, 1));  // y0 z0 y1 z1
  x = _mm256_shuffle_ps(a, xy, _MM_SHUFFLE(2, 0, 3, 0));
  y = _mm256_shuffle_ps(yz, xy, _MM_SHUFFLE(3, 1, 2, 0));
  z = _mm256_shuffle_ps(yz, c, _MM_SHUFFLE(3, 0, 3, 1));
}

#else

// Vectors of four lanes by the compiler's vector extension, for NEON too. NEON intrinsics are used only where the
// extension has no operator.
constexpr int kLanes = 4, kRegisters = VN_ISA == 3 ? 32 : 16;
typedef float F32 __attribute__((vector_size(16)));
typedef int32_t I32 __attribute__((vector_size(16)));
typedef I32 Mask;

VN_INLINE F32 splat(float a) { return F32{a, a, a, a}; }
VN_INLINE I32 splat(int32_t a) { return I32{a, a, a, a}; }
VN_INLINE F32 sub(F32 a, F32 b) { return a - b; }
VN_INLINE F32 mul(F32 a, F32 b) { return a * b; }
VN_INLINE F32 add(F32 a, F32 b) { return a + b; }
VN_INLINE F32 min(F32 a, F32 b) { return a < b ? a : b; }
VN_INLINE F32 max(F32 a, F32 b) { return a > b ? a : b; }
VN_INLINE F32 abs(F32 a) { return reinterpret_cast<F32>(reinterpret_cast<I32>(a) & splat(0x7fffffff)); }
VN_INLINE Mask less(F32 a, F32 b) { return a < b; }
VN_INLINE I32 select(Mask m, I32 a, I32 b) { return (m & a) | (~m & b); }
VN_INLINE void store(int32_t* to, I32 a) { __builtin_memcpy(to, &a, sizeof a); }

#if VN_ISA == 3

VN_INLINE F32 fma(F32 a, F32 b, F32 c) { return vfmaq_f32(c, a, b); }
VN_INLINE F32 square_root(F32 a) { return vsqrtq_f32(a); }
VN_INLINE unsigned bits(Mask m) { return static_cast<unsigned>(vaddvq_s32(m & I32{1, 2, 4, 8})); }
VN_INLINE void zip(F32 a, F32 b, F32& low, F32& high) {
  low = vzip1q_f32(a, b);
  high = vzip2q_f32(a, b);
}
VN_INLINE F32 lane_sums(const F32* v) { return vpaddq_f32(vpaddq_f32(v[0], v[1]), vpaddq_f32(v[2], v[3])); }
VN_INLINE void load_points(const float* p, F32& x, F32& y, F32& z) {
  const float32x4x3_t points = vld3q_f32(p);
  x = points.val[0];
  y = points.val[1];
  z = points.val[2];
}

#else

VN_INLINE F32 fma(F32 a, F32 b, F32 c) { return a * b + c; }
VN_INLINE F32 square_root(F32 a) {
  for (int i = 0; i < kLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
}
VN_INLINE unsigned bits(Mask m) { return (m[0] & 1u) | (m[1] & 2u) | (m[2] & 4u) | (m[3] & 8u); }
VN_INLINE void zip(F32 a, F32 b, F32& low, F32& high) {
  low = F32{a[0], b[0], a[1], b[1]};
  high = F32{a[2], b[2], a[3], b[3]};
}

VN_INLINE F32 lane_sums(const F32* v) {
  F32 sums;
  for (int i = 0; i < 4; ++i) sums[i] = (v[i][0] + v[i][2]) + (v[i][1] + v[i][3]);
  return sums;
}

VN_INLINE void load_points(const float* p, F32& x, F32& y, F32& z) {
  x = F32{p[0], p[3], p[6], p[9]};
  y = F32{p[1], p[4], p[7], p[10]};
  z = F32{p[2], p[5], p[8], p[11]};
}

#endif
#endif

// Transposes kLanes vectors in place: vector i gets lane i of all vectors. Each step rotates the bits of an element's
// index (vector, lane) left by one; after log2(kLanes) steps vector and lane are swapped.
VN_INLINE void transpose(F32* v) {
  for (int step = 1; step < kLanes; step *= 2) {
    F32 transposed[kLanes];
    for (int i = 0; i < kLanes / 2; ++i) zip(v[i], v[i + kLanes / 2], transposed[2 * i], transposed[2 * i + 1]);
    for (int i = 0; i < kLanes; ++i) v[i] = transposed[i];
  }
}

// Vectors of float64 by the compiler's vector extension, of this instruction set's width: the kernels need only
// operators. A comparison gives an I64 mask for `mask ? a : b`.
constexpr int kDoubles = kLanes / 2;
typedef double F64 __attribute__((vector_size(4 * kLanes)));
typedef int64_t I64 __attribute__((vector_size(4 * kLanes)));

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
