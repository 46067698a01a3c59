// Nearest centre among many centres that stay where they are: a grid of candidate lists over all of space.
//
// Every cell of the grid has a list of all centres that are nearest to some point of it, so a query looks at a handful
// of centres and is as exact as nearest_centre.h. |x - a|^2 - |x - b|^2 is linear in x: a centre that another one beats
// at the eight corners of a box it beats in all of the box. Lists are made by halving boxes from all
// of space down and striking out what is beaten, with a margin above the rounding of the definition
// (nearest_centre_math.h), so that a centre struck out would lose in float64 at every point of the cell, in the last
// bit.
//
//   entries  the root grid of 8^bits cells, z fastest, then bricks of 4^3 cells. An entry >= 0 is a place in `lists`,
//   one
//            below 0 is brick ~entry (a place in `entries`) that divides the cell once more.
//   lists    at each place the number of candidates, at least 1, and then their indices, rising.
//   frame    middle and inverse half width along the axes (centre_grid_math.h).
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "geometry/centre_grid_isa.h"

namespace voronerf {

struct CentreGridTables {
  float frame[6];
  int bits;
  std::vector<int32_t> entries, lists;
};

// Finite centres [k,3], k >= 1. This one allocates: how large the tables get shows on the way.
// Memory is bounded by a multiple of k and of the root grid; results do not depend on the number of threads.
std::unique_ptr<CentreGridTables> centre_grid_build(const double* centres, int64_t k, Isa isa, int threads);

// As nearest_centre_cpu; centres are those the grid was built from.
template <typename T>
void nearest_centre_grid_cpu(const T* points, const T* centres, const CentreGrid& grid, int32_t* cells, int64_t n,
                             int64_t k, Isa isa, int threads);

}  // namespace voronerf
