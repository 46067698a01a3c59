// Draws random points in a box on CUDA, one thread per point.
#include "common/cuda_wrappers.h"
#include "rays/draw_points.h"
#include "rays/march_rays_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads)
    draw_points_kernel(const int32_t* __restrict__ seed, const float* __restrict__ box, int64_t n,
                       float* __restrict__ points) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  const uint32_t key = hash_key(*seed, i);
  for (int axis = 0; axis < 3; ++axis) {
    // The product and the sum are rounded separately, as on the CPU.
    const float along = march_product(box[3 + axis] - box[axis], hashed(key, static_cast<uint32_t>(axis)));
    points[3 * i + axis] = box[axis] + along;
  }
}

}  // namespace

void draw_points_cuda(const int32_t* seed, const float* box, int64_t n, float* points, void* stream) {
  if (n == 0) return;
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(n, kThreads));
  VN_LAUNCH(draw_points_kernel, blocks, kThreads, 0, stream, seed, box, n, points);
}

}  // namespace voronerf
