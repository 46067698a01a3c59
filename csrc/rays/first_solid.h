// The first of some solids on rays: origins [r,3] and directions [r,3] -> distance [r] and number [r].
#pragma once

#include <cstdint>

namespace voronerf {

// Kinds, and their measures: 0 box (half sides), 1 sphere (squared radius), 2 cylinder around z (squared radius, half
// height), 3 torus around z (radius of the ring, of the tube, and both together).
struct SolidsOnRays {
  const float* origins;     // [r,3], or [1,3] for all rays
  const float* directions;  // [r,3] unit, or [1,3]
  int64_t r;
  bool one_origin, one_direction;
  const int32_t* kinds;   // [m]
  const float* centres;   // [m,3]
  const float* turns;     // [m,3,3], to the world
  const float* measures;  // [m,3]
  int64_t m;
};

// Distance to the first solid, infinite for a miss, and its number: the lowest of those at one distance, 0 for a miss.
void first_solid_cpu(const SolidsOnRays& in, float* depth, int32_t* number, int threads);

}  // namespace voronerf
