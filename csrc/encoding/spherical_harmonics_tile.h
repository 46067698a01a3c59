// Spherical harmonics of the rows of a tile, a vector of directions at a time: the polynomials give columns, which are
// turned into rows where they lie.
#pragma once

#include "common/memory_tile.h"
#include "encoding/spherical_harmonics_math.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// x [rows, rounded up to whole vectors][3] -> out, as many rows of `stride` floats, at least 16: what harmonics leave
// of the first 16 is 0.
void harmonics_of_rows(const float* x, int64_t rows, int64_t degree, float* out, int64_t stride) {
  for (int64_t row = 0; row < rows; row += kLanes) {
    F32 at_x, at_y, at_z, value[kMostHarmonics];
    load_points(x + 3 * row, at_x, at_y, at_z);
    for (F32& column : value) column = splat(0.0f);
    spherical_harmonics_of(at_x, at_y, at_z, static_cast<int>(degree), value);
    for (int64_t column = 0; column < kMostHarmonics; column += kLanes) {
      transpose(value + column);
      for (int64_t lane = 0; lane < kLanes; ++lane) store(out + (row + lane) * stride + column, value[column + lane]);
    }
  }
}

// Rows of gradients to gradients of x, `out` [rows][3]; x and `gradient` are read in whole vectors of rows, as above.
void harmonics_of_rows_backward(const float* x, const float* gradient, int64_t stride, int64_t rows, int64_t degree,
                                float* out) {
  for (int64_t row = 0; row < rows; row += kLanes) {
    F32 at_x, at_y, at_z, given[kMostHarmonics], found[3];
    load_points(x + 3 * row, at_x, at_y, at_z);
    for (int64_t column = 0; column < kMostHarmonics; column += kLanes) {
      for (int64_t lane = 0; lane < kLanes; ++lane)
        given[column + lane] = load(gradient + (row + lane) * stride + column);
      transpose(given + column);
    }
    spherical_harmonics_gradient(at_x, at_y, at_z, static_cast<int>(degree), given, found);
    float lanes[3][kLanes];
    for (int axis = 0; axis < 3; ++axis) store(lanes[axis], found[axis]);
    for (int64_t lane = 0; lane < kLanes && row + lane < rows; ++lane) {
      for (int axis = 0; axis < 3; ++axis) out[3 * (row + lane) + axis] = lanes[axis][lane];
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
