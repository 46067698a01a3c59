// The frequency encoding of the rows of a tile, and its gradient: [x, sin x,
// cos x, sin 2x, cos 2x, sin 4x, ...], each a block of d features, as in
// voronerf/reference/frequency_encode.py.
//
// A lane is a column of the encoding: a permutation brings it its feature, a
// table its octave and phase, and one sine with one range reduction does the
// rest. So rows come out in the layout the products read, with no
// transposition.
#pragma once

#include "elementwise_math.h"
#include "gemm_tile.h"

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
#else
  return F32{x[index[0]], x[index[1]], x[index[2]], x[index[3]]};
#endif
}

// table [3][stride]: source feature (as an integer), scale and phase of each
// column.
VN_INLINE void encode_table(float* table, int64_t stride, int64_t d, int64_t octaves) {
  for (int64_t column = 0; column < stride; ++column) {
    int32_t feature = static_cast<int32_t>(column);
    float scale = 1.0f, phase = 0.0f;
    if (column >= d) {
      const int64_t octave = (column - d) / (2 * d), within = (column - d) % (2 * d);
      feature = static_cast<int32_t>(within % d);
      phase = within < d ? 0.0f : 0.5f;
      for (int64_t o = 0; o < octave; ++o) scale *= 2.0f;
      if (octave >= octaves) scale = 0.0f;
    }
    __builtin_memcpy(table + column, &feature, sizeof feature);
    table[stride + column] = scale;
    table[2 * stride + column] = phase;
  }
}

// Angles too large for the vector sine, and what is not finite: the C library's
// functions.
void encode_row_exactly(const float* x, const float* table, int64_t stride, int64_t d, int64_t width, float* out) {
  for (int64_t column = d; column < width; ++column) {
    int32_t feature;
    __builtin_memcpy(&feature, table + column, sizeof feature);
    const float angle = x[feature] * table[stride + column];
    out[column] = table[2 * stride + column] == 0.0f ? __builtin_sinf(angle) : __builtin_cosf(angle);
  }
}

// A row by lanes: d <= kLanes, all angles small.
VN_INLINE void encode_row(const float* x, const float* table, Bits raw, int64_t stride, float* out) {
  const F32 features = load(x);
  for (int64_t column = 0; column < stride; column += kLanes) {
    Bits index;
    __builtin_memcpy(&index, table + column, sizeof index);
    const F32 angle = permute(features, index) * load(table + stride + column);
    F32 value = sine(angle, load(table + 2 * stride + column));
    if (column == 0) value = raw ? angle : value;
    store(out + column, value);
  }
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
  bool small = true;
  for (int64_t i = 0; i < count; ++i) small &= __builtin_fabsf(x[i]) < largest;
  return small;
}

// x [rows][d], with kLanes readable floats from every row's start -> out
// [rows][stride].
void encode(const float* x, const float* table, int64_t rows, int64_t d, int64_t octaves, float* out, int64_t stride) {
  const int64_t width = d * (1 + 2 * octaves);
  const float largest = octaves > 0 ? kLargestAngle / table[stride + width - 1] : 0.0f;
  if (octaves > 0 && d <= kLanes && all_small(x, rows * d, largest)) {
    Bits raw;
    for (int lane = 0; lane < kLanes; ++lane) raw[lane] = lane < d ? -1 : 0;
    for (int64_t row = 0; row < rows; ++row) encode_row(x + row * d, table, raw, stride, out + row * stride);
    return;
  }
  for (int64_t row = 0; row < rows; ++row, x += d, out += stride) {
    if (octaves > 0 && all_small(x, d, largest)) {
      encode_row_slowly(x, table, stride, d, out);
    } else if (octaves > 0) {
      encode_row_exactly(x, table, stride, d, width, out);
    }
    for (int64_t f = 0; f < d; ++f) out[f] = x[f];
  }
}

// Gradient to the raw features, from that of the encoding and the encoding
// itself, whose sines and cosines are each other's derivatives.
void encode_backward(const float* value, const float* gradient, const float* table, int64_t rows, int64_t d,
                     int64_t octaves, int64_t stride, float* out) {
  for (int64_t row = 0; row < rows; ++row, value += stride, gradient += stride, out += d) {
    for (int64_t f = 0; f < d; ++f) out[f] = gradient[f];
    for (int64_t octave = 0; octave < octaves; ++octave) {
      const int64_t sine_at = d * (1 + 2 * octave), cosine_at = sine_at + d;
      const float scale = table[stride + sine_at];
      for (int64_t f = 0; f < d; ++f) {
        out[f] += scale * (gradient[sine_at + f] * value[cosine_at + f] - gradient[cosine_at + f] * value[sine_at + f]);
      }
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
