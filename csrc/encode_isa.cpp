// The CPU kernels of the encodings, once for each instruction set.
//
// Tiles of rows are encoded in cache, in rows of whole vectors (frequency_encode_tile.h), and copied to where they
// belong. Backward, a tile is encoded again: its sines and cosines are each other's derivatives, and computing them
// costs less than reading back what is twenty times as large as the input.
#define VN_HALF 0
#include "encode.h"
#include "frequency_encode_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

struct Workspace {
  float *table, *staged, *variances, *value, *blur;
};

VN_INLINE Workspace carve(const Encoding& in, float* workspace, int64_t stride) {
  const int64_t staged = kEncodeRows * in.d + kEncodeLanes;
  Workspace parts;
  parts.table = workspace;
  parts.value = parts.table + 3 * stride;
  parts.blur = parts.value + kEncodeRows * stride;
  parts.staged = parts.blur + kEncodeRows * stride;
  parts.variances = parts.staged + staged;
  // The encoder loads a whole vector from every row.
  for (int64_t i = 0; i < staged; ++i) parts.staged[i] = parts.variances[i] = 0.0f;
  encode_table(parts.table, stride, in.d, in.octaves);
  return parts;
}

// Encodings of `rows` rows from `first`, and how much of each its variance leaves.
VN_INLINE void fill(const Encoding& in, const Workspace& parts, int64_t stride, int64_t first, int64_t rows) {
  __builtin_memcpy(parts.staged, in.x + first * in.d, sizeof(float) * rows * in.d);
  encode(parts.staged, parts.table, rows, in.d, in.octaves, parts.value, stride);
  if (in.variances == nullptr) return;
  __builtin_memcpy(parts.variances, in.variances + first * in.d, sizeof(float) * rows * in.d);
  for (int64_t row = 0; row < rows; ++row) {
    const F32 variances = load(parts.variances + row * in.d);
    for (int64_t column = 0; column < stride; column += kLanes) {
      Bits index;
      __builtin_memcpy(&index, parts.table + column, sizeof index);
      const F32 scale = load(parts.table + stride + column);
      const F32 exponent = permute(variances, index) * (splat(-0.5f) * scale * scale);
      store(parts.blur + row * stride + column, exponent < splat(-87.0f) ? splat(0.0f) : exponential(exponent));
    }
  }
}

// Gradients of `rows` encoded rows, times what the variances leave of them, laid out like the encoding: over the blurs.
VN_INLINE void lay_out(const Encoding& in, const Workspace& parts, int64_t stride, const float* gradient,
                       int64_t rows) {
  const int64_t skipped = in.include_input ? 0 : in.d;
  for (int64_t row = 0; row < rows; ++row, gradient += in.width) {
    float* to = parts.blur + row * stride;
    for (int64_t f = 0; f < skipped; ++f) to[f] = 0.0f;
    if (in.variances == nullptr) {
      for (int64_t column = 0; column < in.width; ++column) to[skipped + column] = gradient[column];
    } else {
      for (int64_t column = 0; column < in.width; ++column) to[skipped + column] *= gradient[column];
    }
  }
}

// The derivative of exp(-4^l variance / 2) is -4^l / 2 times itself.
VN_INLINE void variances_backward(const Encoding& in, const Workspace& parts, int64_t stride, int64_t rows,
                                  float* grad_variances) {
  for (int64_t row = 0; row < rows; ++row, grad_variances += in.d) {
    const float *value = parts.value + row * stride, *gradient = parts.blur + row * stride;
    for (int64_t f = 0; f < in.d; ++f) grad_variances[f] = 0.0f;
    for (int64_t octave = 0; octave < in.octaves; ++octave) {
      const int64_t sine = in.d * (1 + 2 * octave), cosine = sine + in.d;
      const float scale = parts.table[stride + sine], slope = -0.5f * scale * scale;
      for (int64_t f = 0; f < in.d; ++f) {
        grad_variances[f] += slope * (gradient[sine + f] * value[sine + f] + gradient[cosine + f] * value[cosine + f]);
      }
    }
  }
}

}  // namespace

void encode_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin, int64_t end) {
  const Workspace parts = carve(in, workspace, stride);
  const int64_t skipped = in.include_input ? 0 : in.d;
  for (int64_t first = begin; first < end; first += kEncodeRows) {
    const int64_t rows = end - first < kEncodeRows ? end - first : kEncodeRows;
    fill(in, parts, stride, first, rows);
    for (int64_t row = 0; row < rows; ++row) {
      float* to = out + (first + row) * in.width;
      const float *value = parts.value + row * stride + skipped, *blur = parts.blur + row * stride + skipped;
      if (in.variances == nullptr) {
        for (int64_t column = 0; column < in.width; ++column) to[column] = value[column];
      } else {
        for (int64_t column = 0; column < in.width; ++column) to[column] = value[column] * blur[column];
      }
    }
  }
}

void encode_rows_backward(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          float* workspace, int64_t stride, int64_t begin, int64_t end) {
  const Workspace parts = carve(in, workspace, stride);
  for (int64_t first = begin; first < end; first += kEncodeRows) {
    const int64_t rows = end - first < kEncodeRows ? end - first : kEncodeRows;
    fill(in, parts, stride, first, rows);
    lay_out(in, parts, stride, gradient + first * in.width, rows);
    encode_backward(parts.value, parts.blur, parts.table, rows, in.d, in.octaves, stride, grad_x + first * in.d);
    if (in.variances != nullptr) variances_backward(in, parts, stride, rows, grad_variances + first * in.d);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
