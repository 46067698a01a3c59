// unseen_rays on the CPU. The random numbers of a triple are hashes of the seed and the index of its middle ray, so
// that results do not depend on the number of threads.
#include "rays/unseen_rays.h"

#include <cmath>

#include "common/hashed.h"
#include "common/parallel.h"

namespace voronerf {

constexpr uint32_t kBefore = 5;   // hashes of a ray that draw_pixels takes from the same seed
constexpr float kOctaves = 4.0f;  // octaves of the angles between neighbours

void unseen_rays_cpu(const UnseenRays& in, float* origins, float* directions, int threads) {
  constexpr int64_t kTriples = 128;  // triples of a task
  const int64_t triples = in.triples;
  parallel_for(triples, kTriples, threads, [&](int64_t triple) {
    const int64_t middle = in.r - 3 * triples + triple;
    const uint32_t key = hash_key(*in.seed, middle);
    const float tilt = in.tilt * std::exp2(-kOctaves * hashed(key, kBefore + 6));
    const float* const ahead = directions + 3 * middle;
    float* const origin = origins + 3 * middle;
    float aside[3], along = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] += in.move * (2.0f * hashed(key, kBefore + axis) - 1.0f);
      aside[axis] = tilt * (2.0f * hashed(key, kBefore + 3 + axis) - 1.0f);
      along += aside[axis] * ahead[axis];
    }
    float square = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      aside[axis] -= along * ahead[axis];
      square += aside[axis] * aside[axis];
    }
    const float scale = 1.0f / std::sqrt(1.0f + square);
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t one = 3 * (middle + triples) + axis, other = one + 3 * triples;
      origins[one] = origins[other] = origin[axis];
      directions[one] = (ahead[axis] + aside[axis]) * scale;
      directions[other] = (ahead[axis] - aside[axis]) * scale;
    }
  });
}

}  // namespace voronerf
