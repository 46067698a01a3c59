// Nearest centre on CUDA: a thread has two points, centres come through shared memory in tiles that every thread of the
// block reads at the same address (a broadcast), once for both points. Float32 input is screened and, rarely, decided
// again in float64 by nearest_centre_math.h, with the same answer as on the CPU to the last index.
#include "common/cuda_wrappers.h"
#include "geometry/nearest_centre.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kTile = 512;  // centres: 8 KiB of shared memory, 16 bytes each, which are read at once
constexpr int kPoints = 2;  // of a thread

__global__ void __launch_bounds__(kThreads, 4)
    nearest_screened_kernel(const float* __restrict__ points, const float* __restrict__ centres,
                            const int32_t* __restrict__ rows, int32_t* __restrict__ cells, int64_t n, int64_t k) {
  VN_SHARED(tile, float4[kTile]);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kPoints * kThreads + threadIdx.x;
  const int64_t counted = rows == nullptr ? n : *rows;
  float at[kPoints][3], best[kPoints], second[kPoints];
  int32_t cell[kPoints];
#pragma unroll
  for (int p = 0; p < kPoints; ++p) {
    // Threads past the end stay for the barriers, on the last point.
    const int64_t i = first + p * kThreads < n ? first + p * kThreads : n - 1;
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) at[p][axis] = points[3 * i + axis];
    best[p] = second[p] = INFINITY;
    cell[p] = 0;
  }
  for (int64_t start = 0; start < k; start += kTile) {
    const int count = static_cast<int>(k - start < kTile ? k - start : kTile);
    __syncthreads();  // the tile before is read by all
    for (int j = threadIdx.x; j < count; j += kThreads) {
      const float* c = centres + 3 * (start + j);
      tile[j] = make_float4(c[0], c[1], c[2], 0.0f);
    }
    __syncthreads();
    const int32_t number = static_cast<int32_t>(start);
#pragma unroll 4
    for (int j = 0; j < count; ++j) {
      const float4 c = tile[j];
#pragma unroll
      for (int p = 0; p < kPoints; ++p) {
        const float dx = at[p][0] - c.x, dy = at[p][1] - c.y, dz = at[p][2] - c.z;
        const float v = fmaf(dz, dz, fmaf(dy, dy, dx * dx));
        second[p] = fminf(second[p], fmaxf(v, best[p]));
        cell[p] = v < best[p] ? number + j : cell[p];
        best[p] = fminf(v, best[p]);
      }
    }
  }
#pragma unroll
  for (int p = 0; p < kPoints; ++p) {
    const int64_t i = first + p * kThreads;
    if (i >= n) return;
    const bool screened = nearest_is_certain(best[p], second[p]);
    const int32_t found = screened ? cell[p] : nearest_by_definition(points + 3 * i, centres, k);
    cells[i] = i < counted ? found : -1;
  }
}

__global__ void __launch_bounds__(kThreads)
    nearest_centre_kernel(const double* __restrict__ points, const double* __restrict__ centres,
                          const int32_t* __restrict__ rows, int32_t* __restrict__ cells, int64_t n, int64_t k) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) cells[i] = rows == nullptr || i < *rows ? nearest_by_definition(points + 3 * i, centres, k) : -1;
}

unsigned blocks_of(int64_t n, int64_t points) { return static_cast<unsigned>(ceil_div<int64_t>(n, points * kThreads)); }

}  // namespace

template <>
void nearest_centre_cuda(const float* points, const float* centres, const int32_t* rows, int32_t* cells, int64_t n,
                         int64_t k, void* stream) {
  if (n == 0) return;
  VN_LAUNCH(nearest_screened_kernel, blocks_of(n, kPoints), kThreads, 0, stream, points, centres, rows, cells, n, k);
}

template <>
void nearest_centre_cuda(const double* points, const double* centres, const int32_t* rows, int32_t* cells, int64_t n,
                         int64_t k, void* stream) {
  if (n == 0) return;
  VN_LAUNCH(nearest_centre_kernel, blocks_of(n, 1), kThreads, 0, stream, points, centres, rows, cells, n, k);
}

}  // namespace voronerf
