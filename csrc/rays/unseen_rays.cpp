// Each pair is a hash of the number of its first ray, so that results do not depend on the threads.
#include "rays/unseen_rays.h"

#include <cmath>

#include "common/hashed.h"
#include "common/parallel.h"

namespace voronerf {

constexpr uint32_t kBefore = 5;  // numbers of a ray that draw_pixels makes of the same seed

void unseen_rays_cpu(const UnseenRays& in, float* origins, float* directions, int threads) {
  constexpr int64_t kPairs = 256;  // of a task
  parallel_for(in.pairs, kPairs, threads, [&](int64_t pair) {
    const int64_t first = in.r - 2 * in.pairs + pair, second = first + in.pairs;
    const uint32_t key = hash_key(*in.seed, first);
    float* const origin = origins + 3 * first;
    float turned[3], length = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] += in.move * (2.0f * hashed(key, kBefore + axis) - 1.0f);
      origins[3 * second + axis] = origin[axis];
      turned[axis] = directions[3 * first + axis] + in.tilt * (2.0f * hashed(key, kBefore + 3 + axis) - 1.0f);
      length += turned[axis] * turned[axis];
    }
    const float scale = 1.0f / std::sqrt(length);
    for (int axis = 0; axis < 3; ++axis) directions[3 * second + axis] = turned[axis] * scale;
  });
}

}  // namespace voronerf
