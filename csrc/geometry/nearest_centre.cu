// Nearest centre on CUDA: a thread a point, centres through shared memory in tiles that every thread of the block reads
// at the same address (a broadcast). Float32 input is screened and, rarely, decided again in float64 by
// nearest_centre_math.h, with the same answer as on the CPU to the last index.
#include "common/cuda_wrappers.h"
#include "geometry/nearest_centre.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kTile = 512;  // centres: 8 KiB of shared memory with their weights

__global__ void __launch_bounds__(kThreads)
    nearest_centre_kernel(const float* __restrict__ points, const float* __restrict__ centres,
                          const float* __restrict__ weights, int32_t* __restrict__ cells, int64_t n, int64_t k) {
  VN_SHARED(tile, float4[kTile]);
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  // Threads past the end stay for the barriers, on the last point.
  const float* point = points + 3 * (i < n ? i : n - 1);
  const float x = point[0], y = point[1], z = point[2];
  float best = INFINITY, second = INFINITY, weight_bound = 0.0f;
  int32_t cell = 0;
  for (int64_t start = 0; start < k; start += kTile) {
    const int count = static_cast<int>(k - start < kTile ? k - start : kTile);
    __syncthreads();  // the tile before is read by all
    for (int j = threadIdx.x; j < count; j += kThreads) {
      const float* c = centres + 3 * (start + j);
      tile[j] = make_float4(c[0], c[1], c[2], weights == nullptr ? 0.0f : weights[start + j]);
    }
    __syncthreads();
    for (int j = 0; j < count; ++j) {
      const float4 c = tile[j];
      const float dx = x - c.x, dy = y - c.y, dz = z - c.z;
      const float v = fmaf(dz, dz, fmaf(dy, dy, dx * dx)) - c.w;
      weight_bound = fmaxf(weight_bound, fabsf(c.w));
      second = fminf(second, fmaxf(v, best));
      if (v < best) {
        best = v;
        cell = static_cast<int32_t>(start) + j;
      }
    }
  }
  if (i >= n) return;
  // Beyond 1e30 a value can overflow while its difference from the weight does not; see nearest_centre_weight_bound.
  const bool screened = weight_bound <= 1e30f && nearest_is_certain(best, second, weight_bound);
  cells[i] = screened ? cell : nearest_by_definition(point, centres, weights, k);
}

__global__ void __launch_bounds__(kThreads)
    nearest_centre_kernel(const double* __restrict__ points, const double* __restrict__ centres,
                          const double* __restrict__ weights, int32_t* __restrict__ cells, int64_t n, int64_t k) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) cells[i] = nearest_by_definition(points + 3 * i, centres, weights, k);
}

}  // namespace

template <typename T>
void nearest_centre_cuda(const T* points, const T* centres, const T* weights, int32_t* cells, int64_t n, int64_t k,
                         void* stream) {
  if (n == 0) return;
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(n, kThreads));
  VN_LAUNCH(nearest_centre_kernel, blocks, kThreads, 0, stream, points, centres, weights, cells, n, k);
}

template void nearest_centre_cuda(const float*, const float*, const float*, int32_t*, int64_t, int64_t, void*);
template void nearest_centre_cuda(const double*, const double*, const double*, int32_t*, int64_t, int64_t, void*);

}  // namespace voronerf
