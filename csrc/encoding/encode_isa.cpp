// The CPU kernels of the encodings, once for each instruction set.
//
// Tiles of rows are encoded in cache, in rows of whole vectors (frequency_encode_tile.h), and copied to where they
// belong. Backward, a tile is encoded again: its sines and cosines are each other's derivatives, and computing them
// costs less than reading back what is twenty times as large as the input.
#define VN_HALF 0
#include "encoding/encode.h"
#include "encoding/frequency_encode_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

struct Workspace {
  float *table, *staged, *variances, *value;
};

VN_INLINE Columns columns_of(const Encoding& in) { return {in.d, in.octaves, in.include_input}; }

VN_INLINE Workspace carve(const Encoding& in, float* workspace, int64_t stride) {
  const int64_t staged = kEncodeRows * in.d + kEncodeLanes;
  Workspace parts;
  parts.table = workspace;
  parts.value = parts.table + 3 * stride;
  parts.staged = parts.value + kEncodeRows * stride;
  parts.variances = parts.staged + staged;
  // The encoder loads a whole vector from every row.
  for (int64_t i = 0; i < staged; ++i) parts.staged[i] = parts.variances[i] = 0.0f;
  encode_table(parts.table, stride, columns_of(in));
  return parts;
}

// Encodings of `rows` rows from `first`.
VN_INLINE void fill(const Encoding& in, const Workspace& parts, int64_t stride, int64_t first, int64_t rows) {
  __builtin_memcpy(parts.staged, in.x + first * in.d, sizeof(float) * rows * in.d);
  encode(parts.staged, in.d, parts.table, rows, columns_of(in), parts.value, stride);
  if (in.variances == nullptr) return;
  __builtin_memcpy(parts.variances, in.variances + first * in.d, sizeof(float) * rows * in.d);
  blur(parts.variances, in.d, parts.table, rows, parts.value, stride);
}

}  // namespace

void encode_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin, int64_t end) {
  const Workspace parts = carve(in, workspace, stride);
  for (int64_t first = begin; first < end; first += kEncodeRows) {
    const int64_t rows = end - first < kEncodeRows ? end - first : kEncodeRows;
    fill(in, parts, stride, first, rows);
    for (int64_t row = 0; row < rows; ++row) {
      float* to = out + (first + row) * in.width;
      const float* value = parts.value + row * stride;
      // The last vector may write some of the one before again; single floats would take longer than all others.
      if (in.width < kLanes) {
        __builtin_memcpy(to, value, sizeof(float) * in.width);
        continue;
      }
      for (int64_t column = 0; column + kLanes < in.width; column += kLanes) store(to + column, load(value + column));
      store(to + in.width - kLanes, load(value + in.width - kLanes));
    }
  }
}

void encode_rows_backward(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          float* workspace, int64_t stride, int64_t begin, int64_t end) {
  const Workspace parts = carve(in, workspace, stride);
  for (int64_t first = begin; first < end; first += kEncodeRows) {
    const int64_t rows = end - first < kEncodeRows ? end - first : kEncodeRows;
    fill(in, parts, stride, first, rows);
    for (int64_t row = 0; row < rows; ++row) {
      const float *value = parts.value + row * stride, *from = gradient + (first + row) * in.width;
      encode_row_backward(value, from, parts.table, stride, columns_of(in), grad_x + (first + row) * in.d);
      if (in.variances == nullptr) continue;
      blur_row_backward(value, from, parts.table, stride, columns_of(in), grad_variances + (first + row) * in.d);
    }
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
