// The encodings of a tile's positions or directions, and the way back from the gradient of an encoding.
#pragma once

#include "encoding/frequency_encode_tile.h"
#include "encoding/hash_encode_isa.h"
#include "encoding/spherical_harmonics_tile.h"
#include "network/cpu/grouped_mlp_plan.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

VN_INLINE bool has_octaves(const MlpPlanInput& input) {
  return input.encoding.kind == MlpEncodingKind::frequency || input.encoding.kind == MlpEncodingKind::integrated;
}

// Whether the raw rows are points, of which a hash grid or harmonics are computed a vector of rows at a time.
VN_INLINE bool has_points(const MlpPlanInput& input) {
  return input.encoding.kind == MlpEncodingKind::hash || input.encoding.kind == MlpEncodingKind::spherical;
}

VN_INLINE Columns columns_of(const MlpPlanInput& input) {
  const bool integrated = input.encoding.kind == MlpEncodingKind::integrated;
  return {integrated ? input.raw / 2 : input.raw, has_octaves(input) ? input.encoding.size : 0, !integrated};
}

// The hash grid of a cell, for positions that lie in a tile's buffer: a table of the cell's own, or the only one.
VN_INLINE HashEncoding hash_of_cell(const HashEncoding& all, int64_t cell, const float* positions) {
  HashEncoding own = all;
  const int64_t number = all.in.tables > 1 ? cell : 0;
  const int64_t bytes = all.in.type == TableType::float32 ? 4 : 2;
  own.in.table = static_cast<const char*>(all.in.table) + number * all.in.entries * all.features * bytes;
  own.in.tables = 1;
  own.in.positions = positions;
  return own;
}

// Raw rows x, `x_stride` floats apart and as long as `staged` in the plan, -> `value`; with bfloat16 operands also
// `pairs`. `encoded`: hashed positions are there already, and other values are kept beside the pairs.
VN_INLINE void encode_input(const MlpPlanInput& input, const HashEncoding& hash, const float* x, int64_t x_stride,
                            const float* table, int64_t rows, float* value, float* pairs, bool encoded) {
  const int64_t stride = input.value.stride;
  const Columns columns = columns_of(input);
  switch (input.encoding.kind) {
    case MlpEncodingKind::frequency:
      return encode(x, x_stride, table, rows, columns, value, stride, pairs, pairs == nullptr || encoded);
    case MlpEncodingKind::integrated:
      encode(x, x_stride, table, rows, columns, value, stride);
      blur(x + columns.d, x_stride, table, rows, value, stride);
      break;
    case MlpEncodingKind::hash:
      if (!encoded) hash_encode_rows(hash, value, stride, 0, rows);
      break;
    case MlpEncodingKind::spherical:
      harmonics_of_rows(x, rows, input.encoding.size, value, stride);
      break;
    case MlpEncodingKind::none:
      break;
  }
#if VN_HALF
  narrow(value, stride, input.width, rows, pairs);
#endif
}

// Gradient of a raw row of waves, or of features as they came, from that of its encoding.
VN_INLINE void waves_backward(const MlpPlanInput& input, const float* value, const float* gradient, const float* table,
                              float* x) {
  const Columns columns = columns_of(input);
  encode_row_backward(value, gradient, table, input.gradient.stride, columns, x);
  if (input.encoding.kind == MlpEncodingKind::integrated) {
    blur_row_backward(value, gradient, table, input.gradient.stride, columns, x + columns.d);
  }
}

// The same of a tile that is hashed or harmonics: `x` [rows][3], the raw rows, are replaced by their gradient.
VN_INLINE void points_backward(const MlpPlanInput& input, const HashEncoding& hash, const float* gradient, int64_t rows,
                               float* x) {
  if (input.encoding.kind == MlpEncodingKind::hash) {
    hash_encode_positions_backward(hash, gradient, input.gradient.stride, x, 0, rows);
  } else {
    harmonics_of_rows_backward(x, gradient, input.gradient.stride, rows, input.encoding.size, x);
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
