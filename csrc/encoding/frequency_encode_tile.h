// The encodings of the rows of a tile, and their gradients: [x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...], each a
// block of d features, with or without x, as in voronerf/ops/frequency_encode/reference.py; and for a Gaussian of mean
// x each value times exp(-4^l variance / 2), as in integrated_encode beside it.
//
// A lane is a column of the encoding: a permutation brings it its feature, a table its octave and phase, and one sine
// with one range reduction does the rest. So rows come out in the layout the products read, with no transposition.
#pragma once

#include "common/elementwise_math.h"
#include "network/cpu/gemm_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Lane i of the result is lane index[i] of x.
VN_INLINE F32 permute(F32 x, Bits index) {
#if VN_ISA == 2
  return _mm512_maskz_permutexvar_ps(0xffff, reinterpret_cast<__m512i>(index),
                                     x);  // maskz: gcc 12 warns of the other
#elif VN_ISA == 1
  return _mm256_permutevar8x32_ps(x, reinterpret_cast<__m256i>(index));
#elif VN_ISA == 3
  const Bits bytes = index * 0x04040404 + 0x03020100;
  return reinterpret_cast<F32>(vqtbl1q_u8(reinterpret_cast<uint8x16_t>(x), reinterpret_cast<uint8x16_t>(bytes)));
#else
  return F32{x[index[0]], x[index[1]], x[index[2]], x[index[3]]};
#endif
}

// The columns of an encoded row: d features of x themselves, where they are included, then 2d for each octave.
struct Columns {
  int64_t d, octaves;
  bool input;

  int64_t first() const { return input ? d : 0; }  // sine
  int64_t width() const { return first() + 2 * d * octaves; }
};

// table [3][stride]: source feature (as an integer), scale and phase of each column.
VN_INLINE void encode_table(float* table, int64_t stride, const Columns& columns) {
  const int64_t d = columns.d, first = columns.first();
  for (int64_t column = 0; column < stride; ++column) {
    int32_t feature = static_cast<int32_t>(column);
    float scale = 1.0f, phase = 0.0f;
    if (column >= first) {
      const int64_t octave = (column - first) / (2 * d), within = (column - first) % (2 * d);
      feature = static_cast<int32_t>(within % d);
      phase = within < d ? 0.0f : 0.5f;
      for (int64_t o = 0; o < octave; ++o) scale *= 2.0f;
      if (octave >= columns.octaves) scale = 0.0f;
    }
    __builtin_memcpy(table + column, &feature, sizeof feature);
    table[stride + column] = scale;
    table[2 * stride + column] = phase;
  }
}

// Angles too large for the vector sine, and what is not finite: the C library's functions.
void encode_row_exactly(const float* x, const float* table, int64_t stride, const Columns& columns, float* out) {
  for (int64_t column = columns.first(); column < columns.width(); ++column) {
    int32_t feature;
    __builtin_memcpy(&feature, table + column, sizeof feature);
    const float angle = x[feature] * table[stride + column];
    out[column] = table[2 * stride + column] == 0.0f ? __builtin_sinf(angle) : __builtin_cosf(angle);
  }
}

// The work of the lanes of a vector of columns. `raw`: the lanes that hold x itself.
struct Lanes {
  Bits index, raw;
  F32 scale, phase;

  Lanes(const float* table, int64_t stride, int64_t column, const Columns& columns)
      : scale(load(table + stride + column)), phase(load(table + 2 * stride + column)) {
    __builtin_memcpy(&index, table + column, sizeof index);
    for (int lane = 0; lane < kLanes; ++lane) raw[lane] = column + lane < columns.first() ? -1 : 0;
  }
};

// V neighbouring vectors of columns of R rows from `row` on: d <= kLanes, all angles small. Side by side, so that the
// steps of one fill the time in which another waits. `out` and `pairs` as in `encode`, either may be null. kRaw: some
// lanes are raw.
template <int R, int V, bool kRaw>
VN_INLINE void encode_block(const float* x, int64_t x_stride, int64_t row, const Lanes* lanes, float* out,
                            int64_t stride, float* pairs, int64_t pairs_stride) {
  F32 value[R * V], angle[R * V], phase[R * V];
  for (int i = 0; i < R * V; ++i) {
    value[i] = permute(load(x + (row + i / V) * x_stride), lanes[i % V].index) * lanes[i % V].scale;
    if (kRaw) angle[i] = value[i];
    phase[i] = lanes[i % V].phase;
  }
  sines<R * V>(value, phase);
  for (int i = 0; kRaw && i < R * V; ++i) value[i] = lanes[i % V].raw ? angle[i] : value[i];
  for (int i = 0; (!VN_HALF || out != nullptr) && i < R * V; ++i) {
    store(out + (row + i / V) * stride + i % V * kLanes, value[i]);
  }
#if VN_HALF
  for (int r = 0; pairs != nullptr && r < R; ++r) {
    store(pairs + (row + r) * pairs_stride, joined(value[V * r], V == 2 ? value[2 * r + 1] : splat(0.0f)));
  }
#else
  static_cast<void>(pairs), static_cast<void>(pairs_stride);
#endif
}

template <int R, int V, bool kRaw>
VN_INLINE void encode_strip(const float* x, int64_t x_stride, int64_t rows, const Lanes* lanes, float* out,
                            int64_t stride, float* pairs, int64_t pairs_stride) {
  int64_t row = 0;
  for (; row + R <= rows; row += R) encode_block<R, V, kRaw>(x, x_stride, row, lanes, out, stride, pairs, pairs_stride);
  for (; row < rows; ++row) encode_block<1, V, kRaw>(x, x_stride, row, lanes, out, stride, pairs, pairs_stride);
}

// Any number of features.
void encode_row_slowly(const float* x, const float* table, int64_t stride, int64_t d, float* out) {
  for (int64_t column = 0; column < stride; column += kLanes) {
    float features[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      int32_t feature;
      __builtin_memcpy(&feature, table + column + lane, sizeof feature);
      features[lane] = feature < d ? x[feature] : 0.0f;
    }
    store(out + column, sine(load(features) * load(table + stride + column), load(table + 2 * stride + column)));
  }
}

VN_INLINE bool all_small(const float* x, int64_t count, float largest) {
  unsigned small = ~0u;
  int64_t i = 0;
  for (; i + kLanes <= count; i += kLanes) small &= bits(less(abs(load(x + i)), splat(largest)));
  bool rest = (small & ((1u << kLanes) - 1u)) == (1u << kLanes) - 1u;
  for (; i < count; ++i) rest &= __builtin_fabsf(x[i]) < largest;
  return rest;
}

// Rows x, `x_stride` floats apart and with kLanes readable floats from every row's start -> out [rows][stride]; with
// bfloat16 operands also `pairs` [rows][pairs_stride], whole vectors, if not null, and then out only where it is
// `kept`.
void encode(const float* x, int64_t x_stride, const float* table, int64_t rows, const Columns& columns, float* out,
            int64_t stride, float* pairs = nullptr, int64_t pairs_stride = 0, bool kept = true) {
  const int64_t d = columns.d;
  const bool waves = columns.octaves > 0;
  const float largest = waves ? kLargestAngle / table[stride + columns.width() - 1] : 0.0f;
  bool lanes = waves && d <= kLanes;
  if (lanes && x_stride == d) {
    lanes = all_small(x, rows * d, largest);
  } else {
    for (int64_t row = 0; lanes && row < rows; ++row) lanes = all_small(x + row * x_stride, d, largest);
  }
  if (lanes) {
    int64_t column = 0;
#if VN_HALF
    for (; pairs != nullptr && column + 2 * kLanes <= stride; column += 2 * kLanes) {
      const Lanes both[] = {{table, stride, column, columns}, {table, stride, column + kLanes, columns}};
      encode_strip<2, 2, true>(x, x_stride, rows, both, kept ? out + column : nullptr, stride, pairs + column / 2,
                               pairs_stride);
    }
#endif
    for (; column < stride; column += kLanes) {
      const Lanes one(table, stride, column, columns);
      float* to = kept ? out + column : nullptr;
      float* paired = pairs == nullptr ? nullptr : pairs + column / 2;
      if (column < columns.first()) {
        encode_strip<kRegisters / 8, 1, true>(x, x_stride, rows, &one, to, stride, paired, pairs_stride);
      } else {
        encode_strip<kRegisters / 8, 1, false>(x, x_stride, rows, &one, to, stride, paired, pairs_stride);
      }
    }
    column = (stride + 2 * kLanes - 1) / 2 / kLanes * kLanes;  // of pairs: what fills up their rows
    for (; pairs != nullptr && column < pairs_stride; column += kLanes) {
      for (int64_t row = 0; row < rows; ++row) store(pairs + row * pairs_stride + column, splat(0.0f));
    }
    return;
  }
  for (int64_t row = 0; row < rows; ++row) {
    const float* from = x + row * x_stride;
    float* to = out + row * stride;
    if (waves && all_small(from, d, largest)) {
      encode_row_slowly(from, table, stride, d, to);
    } else if (waves) {
      encode_row_exactly(from, table, stride, columns, to);
    }
    for (int64_t f = 0; f < columns.first(); ++f) to[f] = from[f];
  }
#if VN_HALF
  for (int64_t row = 0; pairs != nullptr && row < rows; ++row) {
    narrow_row(out + row * stride, columns.width(), pairs + row * pairs_stride);
  }
#endif
}

// Multiplies encoded rows by the factors of the variances: d <= kLanes, no input among the columns, rows as in
// `encode`.
void blur(const float* variances, int64_t x_stride, const float* table, int64_t rows, float* out, int64_t stride) {
  for (int64_t column = 0; column < stride; column += kLanes) {
    Bits index;
    __builtin_memcpy(&index, table + column, sizeof index);
    const F32 scale = load(table + stride + column), slope = splat(-0.5f) * scale * scale;
    for (int64_t row = 0; row < rows; ++row) {
      float* at = out + row * stride + column;
      const F32 exponent = permute(load(variances + row * x_stride), index) * slope;
      const F32 left = exponent < splat(-87.0f) ? splat(0.0f) : exponential(exponent);
      store(at, load(at) * left);
    }
  }
}

// Gradient to the features of a row, from that of its encoding and the encoding itself, whose sines and cosines are
// each other's derivatives; what variances have left of them is a factor of both.
VN_INLINE void encode_row_backward(const float* value, const float* gradient, const float* table, int64_t stride,
                                   const Columns& columns, float* out) {
  const int64_t d = columns.d;
  for (int64_t f = 0; f < d; ++f) out[f] = columns.input ? gradient[f] : 0.0f;
  for (int64_t octave = 0; octave < columns.octaves; ++octave) {
    const int64_t sine_at = columns.first() + 2 * d * octave, cosine_at = sine_at + d;
    const float scale = table[stride + sine_at];
    for (int64_t f = 0; f < d; ++f) {
      out[f] += scale * (gradient[sine_at + f] * value[cosine_at + f] - gradient[cosine_at + f] * value[sine_at + f]);
    }
  }
}

// ... and to its variances: the derivative of exp(-4^l variance / 2) is -4^l / 2 times itself.
VN_INLINE void blur_row_backward(const float* value, const float* gradient, const float* table, int64_t stride,
                                 const Columns& columns, float* out) {
  const int64_t d = columns.d;
  for (int64_t f = 0; f < d; ++f) out[f] = 0.0f;
  for (int64_t octave = 0; octave < columns.octaves; ++octave) {
    const int64_t sine_at = columns.first() + 2 * d * octave, cosine_at = sine_at + d;
    const float scale = table[stride + sine_at], slope = -0.5f * scale * scale;
    for (int64_t f = 0; f < d; ++f) {
      out[f] += slope * (gradient[sine_at + f] * value[sine_at + f] + gradient[cosine_at + f] * value[cosine_at + f]);
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
