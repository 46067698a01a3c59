// Where a point lies in a centre grid (centre_grid.h): the one map from space to cells, for float32 in vectors, float64
// in scalars, and backwards for the boxes of the cells.
//
// Along each axis u = (x - middle) * inverse is -1 to 1 over the centres' bounding box. Everything else is drawn in
// from outside,
//
//   p = u,  |u| <= 1;      p = sign(u) (1 + (1 - 1 / |u|) / 3),  |u| > 1,
//
// so that p in (-4/3, 4/3) covers all of space, three quarters of it the box, and cut into 2^kCells equal parts it
// numbers the finest cells. Rounding moves a point by less than 4e-7 of that range in float32 (each operation is
// monotone and rounds once), so a cell's box is widened by kWiden on every side: with that it holds every point that
// the map sends there. Beyond kReach the map is of no use, and all centres are searched.
#pragma once

#include <cstdint>

#include "common/hd.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {

constexpr int kCellBits = 12;  // of the finest cells along an axis
constexpr int kBrickBits = 2;  // of a brick along an axis
constexpr double kWiden = 2e-6;
constexpr double kReach = 1024.0;
constexpr double kEdge = 1100.0;  // where the box of an outermost cell ends

// Cell along an axis; -1 beyond reach and for NaN.
VN_HD int32_t grid_cell(double x, double middle, double inverse) {
  const double u = (x - middle) * inverse, size = u < 0.0 ? -u : u;
  if (!(size <= kReach)) return -1;
  const double drawn = size <= 1.0 ? size : 1.0 + (1.0 - 1.0 / size) / 3.0;
  const double scaled = ((u < 0.0 ? -drawn : drawn) + 4.0 / 3.0) * (0.375 * (1 << kCellBits));
  const int32_t last = (1 << kCellBits) - 1;
  return scaled >= last ? last : static_cast<int32_t>(scaled);
}

// nearest_by_definition among the candidates of a list: their number, then their indices, rising.
template <typename T>
VN_HD int32_t nearest_of_list(const T* point, const T* centres, const int32_t* list) {
  double best = 1.7976931348623157e308;
  int32_t cell = 0;
  for (int32_t i = 1; i <= list[0]; ++i) {
    const int32_t j = list[i];
    const double v = squared_distance(static_cast<double>(point[0]), static_cast<double>(point[1]),
                                      static_cast<double>(point[2]), centres + 3 * static_cast<int64_t>(j));
    if (v < best) {
      best = v;
      cell = j;
    }
  }
  return cell;
}

// Coordinate at part t of the range, 0 to 1; what lies outside of it is at the edge of all.
VN_HD double grid_coordinate(double t, double middle, double inverse) {
  const double p = t / 0.375 - 4.0 / 3.0, size = p < 0.0 ? -p : p;
  const double rest = 1.0 - 3.0 * (size - 1.0);
  const double u = size <= 1.0 ? size : rest * kEdge <= 1.0 ? kEdge : 1.0 / rest;
  return middle + (p < 0.0 ? -u : u) / inverse;
}

}  // namespace voronerf
