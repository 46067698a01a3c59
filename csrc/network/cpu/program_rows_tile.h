// Rows of a tile: how operands lie, how stored ones are read and written, and with bfloat16 products how they become
// pairs.
#pragma once

#include "common/memory_tile.h"
#include "network/cpu/bfloat16_tile.h"
#include "network/program_code.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

VN_INLINE int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

// Columns of a value or of a vector: rows of `stride` floats, 0 where they are all the same.
struct Rows {
  const float* data;
  int64_t stride;
  bool spread;
  VN_INLINE F32 vector(const Rows& rows, int64_t row, int64_t column) {
    const float* from = rows.data + row * rows.stride;
    return rows.spread ? splat(*from) : load(from + column);
  }
};

// Few outputs, as heads have, and points are not worth a call of memcpy.
VN_INLINE void copy_row(const float* from, int64_t width, float* to) {
  if (width == 3) {
    __builtin_memcpy(to, from, 3 * sizeof(float));
    return;
  }
  if (width == 4) {
    __builtin_memcpy(to, from, 4 * sizeof(float));
    return;
  }
  int64_t c = 0;
  for (; c + kLanes <= width; c += kLanes) store(to + c, load(from + c));
  if (c < width && width >= kLanes) {
    store(to + width - kLanes, load(from + width - kLanes));
    return;
  }
  for (; c < width; ++c) to[c] = from[c];
}

// bfloat16 is the upper half of a float32. Plain loops: the compiler makes vectors of them.
VN_INLINE void widen_row(const uint16_t* from, int64_t width, float* to) {
  for (int64_t c = 0; c < width; ++c) {
    const uint32_t bits = static_cast<uint32_t>(from[c]) << 16;
    __builtin_memcpy(to + c, &bits, sizeof bits);
  }
}

// To the nearest, ties to even; NaN stays NaN.
VN_INLINE void round_row(const float* from, int64_t width, uint16_t* to) {
#if VN_HALF && VN_ISA == 2
  for (int64_t c = 0; c < width; c += kLanes) {
    const int64_t count = smaller(kLanes, width - c);
    const __m256i rounded = (__m256i)_mm512_cvtneps_pbh(load_some(from + c, count));
    _mm256_mask_storeu_epi16(to + c, static_cast<__mmask16>((1u << count) - 1u), rounded);
  }
#else
  for (int64_t c = 0; c < width; ++c) {
    uint32_t bits;
    __builtin_memcpy(&bits, from + c, sizeof bits);
    const uint32_t rounded = (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
    to[c] = static_cast<uint16_t>((bits & 0x7fffffffu) > 0x7f800000u ? (bits >> 16) | 0x40u : rounded);
  }
#endif
}

// The stride of rows of pairs: whole vectors, which may be written.
VN_INLINE int64_t pairs_of(int64_t width) { return (width + 31) / 32 * 16; }

#if VN_HALF

// Columns as pairs, the last one filled up with 0.
VN_INLINE void narrow_rows(const Rows& x, int64_t width, int64_t rows, float* to, int64_t stride) {
  for (int64_t row = 0; row < rows; ++row) narrow_row(x.data + row * x.stride, width, to + row * stride);
}

// `columns`, a multiple of 16, as pairs of neighbouring rows, [(rows + 1) / 2][columns], the last filled up with 0.
VN_INLINE void interleave_columns(const Rows& x, int64_t columns, int64_t rows, float* to) {
  for (int64_t row = 0; row < rows; row += 2, to += columns) {
    const float* from = x.data + row * x.stride;
    for (int64_t i = 0; i < columns; i += kLanes) {
      store(to + i, interleave(load(from + i), row + 1 < rows ? load(from + x.stride + i) : splat(0.0f)));
    }
  }
}

#endif

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
