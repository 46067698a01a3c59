// Rows of a tile: the layout of operands, loads and stores of rows in memory, and the conversion to pairs for bfloat16
// products.
#pragma once

#include "common/memory_tile.h"
#include "network/cpu/bfloat16_tile.h"
#include "network/program_code.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

VN_INLINE int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

// Columns of a value or vector, in rows of `stride` floats; stride 0: all rows are the same. `spread`: one column is
// broadcast.
struct Operand {
  const float* data;
  int64_t stride;
  bool spread;
  VN_INLINE F32 vector(const Operand& rows, int64_t row, int64_t column) {
    const float* from = rows.data + row * rows.stride;
    return rows.spread ? splat(*from) : load(from + column);
  }
};

// Copies a row. For points and the few outputs of heads, a call of memcpy would be too slow.
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

// Converts bfloat16, the upper half of a float32, to float32. The compiler vectorises the loop.
VN_INLINE void widen_row(const uint16_t* from, int64_t width, float* to) {
  for (int64_t c = 0; c < width; ++c) {
    const uint32_t bits = static_cast<uint32_t>(from[c]) << 16;
    __builtin_memcpy(to + c, &bits, sizeof bits);
  }
}

// Rounds to the nearest bfloat16, ties to even; NaN stays NaN.
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

// Returns the stride in floats of rows that hold `width` values as pairs. Rows are padded to whole vectors, and kernels
// may write the padding.
VN_INLINE int64_t pairs_of(int64_t width) { return (width + 31) / 32 * 16; }

#if VN_HALF

// Clears the padding columns of rows of pairs, where infinity times a weight of 0 may have left NaN.
VN_INLINE void clear_behind(float* pairs, int64_t width, int64_t rows, int64_t stride) {
  const int64_t bytes = 2 * (2 * pairs_of(width) - width);
  for (int64_t row = 0; row < rows && bytes > 0; ++row, pairs += stride) {
    __builtin_memset(static_cast<char*>(static_cast<void*>(pairs)) + 2 * width, 0, static_cast<size_t>(bytes));
  }
}

// Rounds rows to pairs, padded with 0. If `left` is not 0, the rounding remainders follow `left` floats later.
VN_INLINE void narrow_rows(const Operand& x, int64_t width, int64_t rows, float* to, int64_t stride, int64_t left = 0) {
  for (int64_t row = 0; row < rows; ++row, to += stride) {
    narrow_row(x.data + row * x.stride, width, to, left == 0 ? nullptr : to + left);
  }
}

// Joins neighbouring rows to pairs [(rows + 1) / 2][columns]. An odd last row is paired with zeros. `columns` must be a
// multiple of 16.
VN_INLINE void interleave_columns(const Operand& x, int64_t columns, int64_t rows, float* to) {
  for (int64_t row = 0; row < rows; row += 2, to += columns) {
    const float* from = x.data + row * x.stride;
    for (int64_t i = 0; i < columns; i += kLanes) {
      store(to + i, interleave(load(from + i), row + 1 < rows ? load(from + x.stride + i) : splat(0.0f)));
    }
  }
}

#endif

#if VN_HALF == 2

constexpr int64_t kTransposed = 32;  // rows that are joined to 16 pairs

// Copies a row of bfloat16 as pairs, padded with 0.
VN_INLINE void copy_pairs(const uint16_t* from, int64_t width, float* to) {
  for (int64_t i = 0; i < pairs_of(width); i += kLanes, to += kLanes, from += 2 * kLanes) {
    const int64_t count = smaller(2 * kLanes, width - 2 * i);
    F32 pairs = splat(0.0f);
    if (count == 2 * kLanes) {
      __builtin_memcpy(&pairs, from, sizeof pairs);
    } else if (count > 0) {
      __builtin_memcpy(&pairs, from, 2 * count);
    }
    store(to, pairs);
  }
}

// Clears the padding rows of pairs in a slot: the rows after the last row, up to a multiple of 32.
VN_INLINE void clear_behind(const Operand& x, int64_t columns, int64_t rows) {
  float* const data = const_cast<float*>(x.data);
  for (int64_t row = rows; row % kTransposed != 0; ++row) {
    for (int64_t i = 0; i < pairs_of(columns); i += kLanes) store(data + row * x.stride + i, splat(0.0f));
  }
}

VN_INLINE Operand behind(const Operand& x, int64_t floats) { return {x.data + floats, x.stride, x.spread}; }

// Converts rows of pairs to pairs of neighbouring rows, transposed to [columns][stride]. `columns` must be a multiple
// of 16.
VN_INLINE void turn_pairs(const Operand& x, int64_t columns, int64_t rows, float* to, int64_t stride) {
  clear_behind(x, columns, rows);
#if VN_ISA == 2
  // Eight columns are transposed at a time. 128-bit lane l of vector i holds the columns of pair i + 4 l, so shuffles
  // within lanes give the right order. Transposing whole vectors would take twice as many shuffles.
  for (int64_t row = 0; row < rows; row += kTransposed) {
    for (int64_t column = 0; column < columns; column += 8) {
      const float* const from = x.data + row * x.stride + column / 2;
      float* const transposed = to + column * stride + row / 2;
      const auto lanes = [&](int64_t first) {
        const auto lane = [&](int64_t l) {
          return _mm_loadu_si128(reinterpret_cast<const __m128i*>(from + (first + 8 * l) * x.stride));
        };
        const __m512i low = _mm512_inserti32x4(_mm512_castsi128_si512(lane(0)), lane(1), 1);
        return _mm512_inserti32x4(_mm512_inserti32x4(low, lane(2), 2), lane(3), 3);
      };
      __m512i left[4], right[4];  // the first and the last four columns
      for (int64_t i = 0; i < 4; ++i) {
        const __m512i even = lanes(2 * i), odd = lanes(2 * i + 1);
        left[i] = _mm512_unpacklo_epi16(even, odd);
        right[i] = _mm512_unpackhi_epi16(even, odd);
      }
      const auto turn = [&](const __m512i* v, float* out) {
        const __m512i a = _mm512_maskz_unpacklo_epi32(0xffff, v[0], v[1]);
        const __m512i b = _mm512_maskz_unpackhi_epi32(0xffff, v[0], v[1]);
        const __m512i c = _mm512_maskz_unpacklo_epi32(0xffff, v[2], v[3]);
        const __m512i d = _mm512_maskz_unpackhi_epi32(0xffff, v[2], v[3]);
        store(out, (F32)_mm512_maskz_unpacklo_epi64(0xff, a, c));
        store(out + stride, (F32)_mm512_maskz_unpackhi_epi64(0xff, a, c));
        store(out + 2 * stride, (F32)_mm512_maskz_unpacklo_epi64(0xff, b, d));
        store(out + 3 * stride, (F32)_mm512_maskz_unpackhi_epi64(0xff, b, d));
      };
      turn(left, transposed);
      turn(right, transposed + 4 * stride);
    }
  }
#else
  for (int64_t column = 0; column < columns; ++column) {
    auto* const transposed = reinterpret_cast<uint16_t*>(to + column * stride);
    for (int64_t row = 0; row < 2 * pairs_of(rows); ++row) {
      __builtin_memcpy(transposed + row, reinterpret_cast<const uint16_t*>(x.data + row * x.stride) + column, 2);
    }
  }
#endif
}

// Converts rows of pairs to pairs of neighbouring rows, [row pairs][columns]. `columns` must be a multiple of 16.
VN_INLINE void zip_pairs(const Operand& x, int64_t columns, int64_t rows, float* to) {
  clear_behind(x, columns, rows);
  for (int64_t row = 0; row < 2 * pairs_of(rows); row += 2, to += columns) {
    const float *even = x.data + row * x.stride, *odd = even + x.stride;
#if VN_ISA == 2
    for (int64_t column = 0; column < columns; column += 2 * kLanes) {
      F32 low, high;
      zip_halves(load(even + column / 2), load(odd + column / 2), low, high);
      store(to + column, low);
      if (column + kLanes < columns) store(to + column + kLanes, high);
    }
#else
    for (int64_t column = 0; column < columns; ++column) {
      auto* const pair = reinterpret_cast<uint16_t*>(to + column);
      __builtin_memcpy(pair, reinterpret_cast<const uint16_t*>(even) + column, 2);
      __builtin_memcpy(pair + 1, reinterpret_cast<const uint16_t*>(odd) + column, 2);
    }
#endif
  }
}

// Adds the sums over rows of pairs to `to` [columns], or overwrites it if `first`.
VN_INLINE void add_pairs(const Operand& x, int64_t columns, int64_t rows, bool first, float* to) {
  for (int64_t column = 0; column < columns; column += 2 * kLanes) {
    const bool both = column + kLanes < columns;
    F32 even[] = {splat(0.0f), splat(0.0f)}, odd[] = {splat(0.0f), splat(0.0f)};  // even and odd columns, by row parity
    for (int64_t row = 0; row < rows; ++row) {
      const F32 values = load(x.data + row * x.stride + column / 2);
      even[row % 2] = even[row % 2] + lower_of(values);
      odd[row % 2] = odd[row % 2] + upper_of(values);
    }
    F32 low, high;
    zip(even[0] + even[1], odd[0] + odd[1], low, high);
    store(to + column, first ? low : low + load(to + column));
    if (both) store(to + column + kLanes, first ? high : high + load(to + column + kLanes));
  }
}

#endif

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
