// draw_points on the CPU: threads share blocks of points. A point's coordinates follow from hashes of the seed and the
// point's index, so the result does not depend on the number of threads.
#include "rays/draw_points.h"

#include "common/hashed.h"
#include "common/parallel.h"

namespace voronerf {

void draw_points_cpu(const int32_t* seed, const float* box, RowCount n, float* points, int threads) {
  constexpr int64_t kPoints = 1024;  // points of a task
  const float extent[3] = {box[3] - box[0], box[4] - box[1], box[5] - box[2]};
  parallel_for(n, kPoints, threads, [&](int64_t i) {
    const uint32_t key = hash_key(*seed, i);
    for (uint32_t axis = 0; axis < 3; ++axis) points[3 * i + axis] = box[axis] + extent[axis] * hashed(key, axis);
  });
}

}  // namespace voronerf
