// Replaces the last 3 * triples of r rays by triples of neighbouring rays from positions without a camera. The formulas
// are in voronerf/ops/unseen_rays.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct UnseenRays {
  const int32_t* seed;  // [1]
  float move, tilt;
  RowCount triples, r;
};

// Changes the last 3 * triples rows of origins and directions [r,3] in place.
void unseen_rays_cpu(const UnseenRays& in, float* origins, float* directions, int threads);

}  // namespace voronerf
