// The frequency encoding of the rows of a tile, and its gradient: [x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...], each
// a block of d features, with or without x, as in voronerf/ops/frequency_encode/reference.py. For a Gaussian with mean
// x each value is multiplied by exp(-4^l variance / 2), as in voronerf/ops/integrated_encode.
//
// A lane is a column of the encoding. A permutation selects its feature, a table gives its octave and phase, and one
// sine with one range reduction computes it. So rows have the layout that the products read, without a transposition.
// Encodings for tile registers are computed by encode_transposed.
#pragma once

#include "common/elementwise_math.h"
#include "network/cpu/gemm_tile.h"
#include "network/cpu/program_rows_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Returns a vector whose lane i is lane index[i] of x.
VN_INLINE F32 permute(F32 x, Bits index) {
#if VN_ISA == 2
  return _mm512_maskz_permutexvar_ps(0xffff, reinterpret_cast<__m512i>(index),
                                     x);  // maskz: gcc 12 warns about the plain intrinsic
#elif VN_ISA == 1
  return _mm256_permutevar8x32_ps(x, reinterpret_cast<__m256i>(index));
#elif VN_ISA == 3
  const Bits bytes = index * 0x04040404 + 0x03020100;
  return reinterpret_cast<F32>(vqtbl1q_u8(reinterpret_cast<uint8x16_t>(x), reinterpret_cast<uint8x16_t>(bytes)));
#else
  return F32{x[index[0]], x[index[1]], x[index[2]], x[index[3]]};
#endif
}

// The columns of an encoded row: the d features of x if `input` is set, then 2d columns for each octave.
struct Columns {
  int64_t d, octaves;
  bool input;

  int64_t first() const { return input ? d : 0; }  // column of the first sine
  int64_t width() const { return first() + 2 * d * octaves; }
};

// The tag of this kernel in encodings.h.
template <bool kBlurred>
struct Octaves {};

// Fills table [3][stride]: source feature (as an integer), scale and phase of each column.
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

// Encodes a row with angles that are too large for the vector sine or not finite, by the C library's functions.
void encode_row_exactly(const float* x, const float* table, int64_t stride, const Columns& columns, float* out) {
  for (int64_t column = columns.first(); column < columns.width(); ++column) {
    int32_t feature;
    __builtin_memcpy(&feature, table + column, sizeof feature);
    const float angle = x[feature] * table[stride + column];
    out[column] = table[2 * stride + column] == 0.0f ? __builtin_sinf(angle) : __builtin_cosf(angle);
  }
}

// The per-lane constants of a vector of columns. `raw` masks the lanes that hold x itself.
struct Lanes {
  Bits index, raw;
  F32 scale, phase;

  Lanes(const float* table, int64_t stride, int64_t column, const Columns& columns)
      : scale(load(table + stride + column)), phase(load(table + 2 * stride + column)) {
    __builtin_memcpy(&index, table + column, sizeof index);
    for (int lane = 0; lane < kLanes; ++lane) raw[lane] = column + lane < columns.first() ? -1 : 0;
  }
};

// Encodes a vector of columns of R rows from `row` on, for d <= kLanes and small angles. Interleaving R rows hides
// latency. kRaw: some lanes hold x itself.
template <int R, bool kRaw>
VN_INLINE void encode_block(const float* x, int64_t x_stride, int64_t row, const Lanes& lanes, float* out,
                            int64_t stride) {
  F32 value[R], angle[R], phase[R];
  for (int r = 0; r < R; ++r) {
    value[r] = permute(load(x + (row + r) * x_stride), lanes.index) * lanes.scale;
    if (kRaw) angle[r] = value[r];
    phase[r] = lanes.phase;
  }
  sines<R>(value, phase);
  for (int r = 0; kRaw && r < R; ++r) value[r] = lanes.raw ? angle[r] : value[r];
  for (int r = 0; r < R; ++r) store(out + (row + r) * stride, value[r]);
}

template <bool kRaw>
VN_INLINE void encode_strip(const float* x, int64_t x_stride, int64_t rows, const Lanes& lanes, float* out,
                            int64_t stride) {
  constexpr int R = kRegisters / 8;
  int64_t row = 0;
  for (; row + R <= rows; row += R) encode_block<R, kRaw>(x, x_stride, row, lanes, out, stride);
  for (; row < rows; ++row) encode_block<1, kRaw>(x, x_stride, row, lanes, out, stride);
}

#if VN_HALF == 2

constexpr int64_t kMostTransposed = 128;  // columns of `encode_transposed`

// Encodes up to kTransposed rows with small angles, and writes only pairs of bfloat16 numbers, no floats. Lanes are
// rows. Sine and cosine of a feature share a range reduction, and each octave follows from the previous one by the
// double-angle formulas, which double the error. So every fifth octave is computed directly: the error stays at 2e-6,
// while rounding to bfloat16 causes 2e-3. All columns are transposed at the end.
void encode_transposed(const float* x, int64_t x_stride, int64_t rows, const Columns& columns, float* pairs,
                       int64_t pairs_stride) {
  constexpr int kVectors = kTransposed / kLanes;
  constexpr int64_t kRow = kTransposed / 2, kOctavesOfOne = 5;
  const int64_t d = columns.d;
  alignas(64) float encoded[kMostTransposed][kRow];
  const auto put = [&](int64_t column, const F32* values) {
    for (int v = 0; v < kVectors; v += 2) store(encoded[column] + v * kLanes / 2, joined(values[v], values[v + 1]));
  };
  F32 points[3][kVectors];
  const bool direct = d == 3 && x_stride == 3 && rows == kTransposed;
  for (int v = 0; direct && v < kVectors; ++v) {
    load_points(x + 3 * v * kLanes, points[0][v], points[1][v], points[2][v]);
  }
  for (int64_t f = 0; f < d; ++f) {
    F32 values_of_x[kVectors], sine[kVectors] = {}, cosine[kVectors] = {};  // octave 0 sets them, which gcc cannot tell
    float lanes[kTransposed];
    for (int64_t row = 0; !direct && row < kTransposed; ++row) lanes[row] = x[smaller(row, rows - 1) * x_stride + f];
    for (int v = 0; v < kVectors; ++v) values_of_x[v] = direct ? points[f][v] : load(lanes + v * kLanes);
    if (columns.input) put(f, values_of_x);
    float scale = 1.0f;
    for (int64_t octave = 0, at = columns.first() + f; octave < columns.octaves; ++octave, at += 2 * d, scale *= 2.0f) {
      if (octave % kOctavesOfOne == 0) {
        F32 angle[kVectors];
        for (int v = 0; v < kVectors; ++v) angle[v] = values_of_x[v] * splat(scale);
        sines_and_cosines<kVectors>(angle, sine, cosine);
      } else {
        for (int v = 0; v < kVectors; ++v) {
          const F32 twice = sine[v] + sine[v];
          const F32 next = twice * cosine[v];
          cosine[v] = splat(1.0f) - twice * sine[v];
          sine[v] = next;
        }
      }
      put(at, sine);
      put(at + d, cosine);
    }
  }
  const int64_t width = columns.width();
  for (int64_t c = width; c % kTransposed != 0; ++c) __builtin_memset(encoded[c], 0, sizeof encoded[c]);
  for (int64_t c = 0; c < width; c += kTransposed) {
    turn_pairs({encoded[c], kRow, false}, kTransposed, kTransposed, pairs + c / 2, pairs_stride);
  }
}

#endif

// Encodes a row with any number of features.
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

// Encodes rows x, `x_stride` floats apart and with kLanes readable floats from every row's start -> out [rows][stride].
VN_INLINE void encode_floats(const float* x, int64_t x_stride, const float* table, int64_t rows, const Columns& columns,
                             bool lanes, float largest, float* out, int64_t stride) {
  if (lanes) {
    for (int64_t column = 0; column < stride; column += kLanes) {
      const Lanes vector(table, stride, column, columns);
      if (column < columns.first()) {
        encode_strip<true>(x, x_stride, rows, vector, out + column, stride);
      } else {
        encode_strip<false>(x, x_stride, rows, vector, out + column, stride);
      }
    }
    return;
  }
  for (int64_t row = 0; row < rows; ++row) {
    const float* from = x + row * x_stride;
    float* to = out + row * stride;
    if (columns.octaves > 0 && all_small(from, columns.d, largest)) {
      encode_row_slowly(from, table, stride, columns.d, to);
    } else if (columns.octaves > 0) {
      encode_row_exactly(from, table, stride, columns, to);
    }
    for (int64_t f = 0; f < columns.first(); ++f) to[f] = from[f];
  }
}

// Encodes rows as encode_floats does. For tile registers, the result is also rounded to pairs of bfloat16 numbers in
// `pairs` [rows][pairs_stride], unless it is null; its rows are whole vectors. If `left` is not 0, the remainders of
// this rounding are stored as pairs too, `left` floats after the pairs. If `pairs` is given and `kept` is false (no
// step reads the floats), `out` may stay unwritten.
void encode(const float* x, int64_t x_stride, const float* table, int64_t rows, const Columns& columns, float* out,
            int64_t stride, [[maybe_unused]] float* pairs = nullptr, [[maybe_unused]] int64_t pairs_stride = 0,
            [[maybe_unused]] int64_t left = 0, [[maybe_unused]] bool kept = true) {
  const int64_t d = columns.d;
  const bool waves = columns.octaves > 0;
  const float largest = waves ? kLargestAngle / table[stride + columns.width() - 1] : 0.0f;
  bool small = waves;
  if (x_stride == d) {
    small = small && all_small(x, rows * d, largest);
  } else {
    for (int64_t row = 0; small && row < rows; ++row) small = all_small(x + row * x_stride, d, largest);
  }
#if VN_HALF == 2
  if (pairs != nullptr && !kept && left == 0 && waves && columns.width() <= kMostTransposed) {
    for (int64_t row = 0; row < rows; row += kTransposed) {
      encode_transposed(x + row * x_stride, x_stride, smaller(kTransposed, rows - row), columns,
                        pairs + row * pairs_stride, pairs_stride);
    }
    for (int64_t row = 0; !small && row < rows; ++row) {  // corrects only rows with large angles
      const float* const from = x + row * x_stride;
      if (all_small(from, d, largest)) continue;
      encode_floats(from, x_stride, table, 1, columns, false, largest, out, stride);
      narrow_row(out, columns.width(), pairs + row * pairs_stride);
    }
    return;
  }
#endif
  encode_floats(x, x_stride, table, rows, columns, small && d <= kLanes, largest, out, stride);
#if VN_HALF == 2
  if (pairs != nullptr) narrow_rows({out, stride, false}, columns.width(), rows, pairs, pairs_stride, left);
#endif
}

// Multiplies encoded rows by the damping factors of the d variances, for an encoding without x itself. Rows are as in
// `encode`. No more than d variances of a row are read, which may be the last of their tensor.
void blur(const float* variances, int64_t d, int64_t x_stride, const float* table, int64_t rows, float* out,
          int64_t stride) {
  // A vector that begins with the variances of one of these rows ends before the last row does.
  const int64_t whole = d <= kLanes ? rows - (kLanes - d + x_stride - 1) / x_stride : 0;
  for (int64_t column = 0; column < stride; column += kLanes) {
    Bits index;
    __builtin_memcpy(&index, table + column, sizeof index);
    const F32 scale = load(table + stride + column), slope = splat(-0.5f) * scale * scale;
    for (int64_t row = 0; row < rows; ++row) {
      const float* from = variances + row * x_stride;
      F32 variance;
      if (row < whole) {
        variance = permute(load(from), index);
      } else {
        float lanes[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = from[index[lane]];
        variance = load(lanes);
      }
      float* at = out + row * stride + column;
      const F32 exponent = variance * slope;
      const F32 left = exponent < splat(-87.0f) ? splat(0.0f) : exponential(exponent);
      store(at, load(at) * left);
    }
  }
}

// Computes the gradient of a row's features from its encoding `value` and the encoding's gradient. Sines and cosines
// are each other's derivatives, and both contain the damping factor.
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

// Computes the gradient of a row's variances: the derivative of the factor exp(-4^l variance / 2) is -4^l / 2 times the
// factor.
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
