// The nested query on CUDA: one thread per point walks down the tree. Each level is nearest_centre for one diagram,
// screened in float32 and decided in float64 if float32 is not certain (nearest_centre_math.h). Neighbouring samples of
// a ray share their diagrams, so that the centres come from the L1 cache.
#include "common/cuda_wrappers.h"
#include "geometry/locate_cell.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;

__device__ int32_t nearest_in_diagram(const float* point, const float* centres, int32_t k) {
  const float x = point[0], y = point[1], z = point[2];
  float best = INFINITY, second = INFINITY;
  int32_t cell = 0;
  for (int32_t j = 0; j < k; ++j) {
    const float dx = x - centres[3 * j], dy = y - centres[3 * j + 1], dz = z - centres[3 * j + 2];
    const float v = fmaf(dz, dz, fmaf(dy, dy, dx * dx));
    second = fminf(second, fmaxf(v, best));
    if (v < best) {
      best = v;
      cell = j;
    }
  }
  return nearest_is_certain(best, second) ? cell : nearest_by_definition<3>(point, centres, k);
}

__device__ int32_t nearest_in_diagram(const double* point, const double* centres, int32_t k) {
  return nearest_by_definition<3>(point, centres, k);
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    locate_cell_kernel(const T* __restrict__ points, const T* __restrict__ centres,
                       const int32_t* __restrict__ child_offsets, const int32_t* __restrict__ child,
                       const int32_t* __restrict__ rows, int32_t* __restrict__ leaves, int64_t n, int64_t m, int64_t g,
                       int depth) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  if (rows != nullptr && i >= *rows) {
    leaves[i] = -1;
    return;
  }
  int32_t state = 0;  // the point's diagram, or a negative number for its leaf
  for (int d = 0; d < depth && state >= 0; ++d) {
    if (state >= g) break;
    const int32_t first = child_offsets[state], end = child_offsets[state + 1];
    if (first < 0 || end <= first || end > m) break;
    const int32_t centre = nearest_in_diagram(points + 3 * i, centres + 3 * static_cast<int64_t>(first), end - first);
    state = child[first + centre];
  }
  leaves[i] = ~state;  // -state - 1, which could overflow; negative if the walk has reached no leaf
}

}  // namespace

template <typename T>
void locate_cell_cuda(const T* points, const T* centres, const int32_t* child_offsets, const int32_t* child,
                      const int32_t* rows, int32_t* leaves, int64_t n, int64_t m, int64_t g, int depth, void* stream) {
  if (n == 0) return;
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(n, kThreads));
  VN_LAUNCH((locate_cell_kernel<T>), blocks, kThreads, 0, stream, points, centres, child_offsets, child, rows, leaves,
            n, m, g, depth);
}

template void locate_cell_cuda(const float*, const float*, const int32_t*, const int32_t*, const int32_t*, int32_t*,
                               int64_t, int64_t, int64_t, int, void*);
template void locate_cell_cuda(const double*, const double*, const int32_t*, const int32_t*, const int32_t*, int32_t*,
                               int64_t, int64_t, int64_t, int, void*);

}  // namespace voronerf
