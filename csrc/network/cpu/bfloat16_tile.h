// Operands of bfloat16 products, made from float32 rows. Two values share 32 bits, so a pair is handled as one float by
// what only moves data: blocks broadcast it, panels are laid out by it (gemm_tile.h). Along k, what a pair joins is
// neighbouring columns of a row (`narrow`), or neighbouring rows of a column (`interleave`) where the samples are k.
#pragma once

#include "common/memory_tile.h"

#if VN_HALF

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

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

// `width` floats -> pairs, the last filled up with 0. Whole vectors are written: 16 pairs at a time.
VN_INLINE void narrow_row(const float* from, int64_t width, float* to) {
  for (int64_t i = 0; i < width; i += 2 * kLanes) {
    store(to + i / 2, joined(load_some(from + i, width - i), load_some(from + i + kLanes, width - i - kLanes)));
  }
}

// [rows][stride] floats, stride a multiple of 16 -> [rows][stride / 2] pairs, of which the first (width + 1) / 2 count.
VN_INLINE void narrow(const float* from, int64_t stride, int64_t width, int64_t rows, float* to) {
  const int64_t whole = width / (2 * kLanes) * (2 * kLanes);
  for (int64_t row = 0; row < rows; ++row, from += stride, to += stride / 2) {
    for (int64_t i = 0; i < whole; i += 2 * kLanes) store(to + i / 2, joined(load(from + i), load(from + i + kLanes)));
    if (whole < width) {
      const F32 last =
          joined(load_some(from + whole, width - whole), load_some(from + whole + kLanes, width - whole - kLanes));
      // Half a vector where that is what is left of the row.
      _mm512_mask_storeu_ps(to + whole / 2, stride - whole >= 2 * kLanes ? 0xffffu : 0xffu, last);
    }
  }
}

// [rows][stride] floats -> [(rows + 1) / 2][stride] pairs of neighbouring rows, the last filled up with 0.
VN_INLINE void interleave_rows(const float* from, int64_t stride, int64_t rows, float* to) {
  for (int64_t row = 0; row < rows; row += 2, from += 2 * stride, to += stride) {
    for (int64_t i = 0; i < stride; i += kLanes) {
      store(to + i, interleave(load(from + i), row + 1 < rows ? load(from + stride + i) : splat(0.0f)));
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#endif
