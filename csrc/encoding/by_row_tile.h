// Encodes the rows of a tile by a row formula (encodings.h), a vector of rows at a time. The formula yields columns,
// which are then transposed in place.
#pragma once

#include "network/cpu/functions_tile.h"
#include "network/cpu/program_rows_tile.h"
// after functions_tile.h, which defines VN_WORDS
#include "encoding/encodings.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

template <typename Formula>
struct ByRow {
  static constexpr int64_t kColumns = (Formula::kMost + kLanes - 1) / kLanes * kLanes;

  // A function that returns column i of x [rows][stride] as a vector of the rows from `row` on. Lanes after the last
  // row repeat the last row.
  struct Of {
    const float* x;
    int64_t stride, row, rows;
    F32 first[3];

    __attribute__((always_inline)) Of(const float* x, int64_t stride, int64_t raw, int64_t row, int64_t rows)
        : x(x), stride(stride), row(row), rows(rows) {
      if (raw == 3 && stride == 3) {
        load_points(x + 3 * row, first[0], first[1], first[2]);
      } else {
        for (int i = 0; i < 3; ++i) first[i] = gathered(smaller(i, raw - 1));
      }
    }
    __attribute__((always_inline)) F32 gathered(int64_t column) const {
      float lanes[kLanes];
      for (int64_t lane = 0; lane < kLanes; ++lane) lanes[lane] = x[smaller(row + lane, rows - 1) * stride + column];
      return load(lanes);
    }
    __attribute__((always_inline)) F32 operator()(int column) const {
      return column < 3 ? first[column] : gathered(column);
    }
  };

  // Encodes x [rows][x_stride], `raw` columns of each row -> out [rows, rounded up to whole vectors][stride], with 0
  // after the columns of the encoding. If raw and x_stride are 3, x must be readable for the rounded number of rows.
  static void values(const float* x, int64_t x_stride, int64_t raw, int64_t size, int64_t rows, float* out,
                     int64_t stride) {
    for (int64_t row = 0; row < rows; row += kLanes) {
      F32 value[kColumns];
      for (F32& column : value) column = splat(0.0f);
      const Of of(x, x_stride, raw, row, rows);
      Formula::values(of, static_cast<int>(raw), static_cast<int>(size), [&](int c, F32 v) { value[c] = v; });
      for (int64_t column = 0; column < kColumns && column < stride; column += kLanes) {
        transpose(value + column);
        for (int64_t lane = 0; lane < kLanes; ++lane) store(out + (row + lane) * stride + column, value[column + lane]);
      }
    }
  }

  // Turns gradients g [rows][g_stride] into gradients of x, out [rows][stride].
  static void gradient(const float* x, int64_t x_stride, int64_t raw, int64_t size, const float* g, int64_t g_stride,
                       int64_t rows, float* out, int64_t stride) {
    for (int64_t row = 0; row < rows; row += kLanes) {
      const int64_t count = smaller(kLanes, rows - row);
      const float* const from = g + row * g_stride;
      F32 gradients[kColumns];
      for (F32& column : gradients) column = splat(0.0f);
      for (int64_t column = 0; column < kColumns && column < g_stride; column += kLanes) {
        for (int64_t lane = 0; lane < kLanes; ++lane) {
          gradients[column + lane] = load(from + smaller(lane, count - 1) * g_stride + column);
        }
        transpose(gradients + column);
      }
      const Of of(x, x_stride, raw, row, rows);
      F32 first[3] = {splat(0.0f), splat(0.0f), splat(0.0f)};  // the first three columns, written together
      float* const to = out + row * stride;
      const auto put = [&](int i, F32 v) __attribute__((always_inline)) {
        if (i < 3) {
          first[i] = v;
          return;
        }
        float lanes[kLanes];
        store(lanes, v);
        for (int64_t lane = 0; lane < count; ++lane) to[lane * stride + i] = lanes[lane];
      };
      Formula::gradient(of, static_cast<int>(raw), static_cast<int>(size), [&](int c) { return gradients[c]; }, put);
      float lanes[3][kLanes];
      for (int i = 0; i < 3; ++i) store(lanes[i], first[i]);
      for (int64_t lane = 0; lane < count; ++lane) {
        for (int i = 0; i < 3 && i < raw; ++i) to[lane * stride + i] = lanes[i][lane];
      }
    }
  }
};

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
