// Triples of neighbouring rays from where no camera was: the last of r rays. What it computes is said in
// voronerf/ops/unseen_rays.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct UnseenRays {
  const int32_t* seed;  // [1]
  float move, tilt;
  RowCount triples, r;
};

// Changes origins and directions: [r,3].
void unseen_rays_cpu(const UnseenRays& in, float* origins, float* directions, int threads);

}  // namespace voronerf
