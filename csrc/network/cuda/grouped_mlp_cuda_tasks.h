// The map from blocks to rows of cells, which the device makes, so that the host does not read the offsets.
#pragma once

#include "common/cuda_wrappers.h"

namespace voronerf {

constexpr int kScanThreads = 1024;

// first_task [k+1] by one block of kScanThreads: the running sum of tasks_of(cell). Cells that overlap, which offsets
// that fall make, could have more tasks than `most`, what the grid has blocks for and the workspace partials: no number
// exceeds it, and what such cells get is undefined.
template <typename Tasks>
__device__ void number_tasks(int64_t k, int64_t most, int32_t* first_task, const Tasks& tasks_of) {
  VN_SHARED(sums, int64_t[32]);
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const auto inside = [most](int64_t tasks) { return static_cast<int32_t>(tasks < most ? tasks : most); };
  int64_t carry = 0;
  for (int64_t start = 0; start < k; start += kScanThreads) {
    const int64_t cell = start + threadIdx.x;
    const int64_t tasks = cell < k ? tasks_of(cell) : 0;
    int64_t running = tasks;
    for (int step = 1; step < 32; step *= 2) {
      const int64_t other = __shfl_up_sync(kAllLanes, running, step);
      if (lane >= step) running += other;
    }
    if (lane == 31) sums[warp] = running;
    __syncthreads();
    int64_t before = carry, total = 0;
    for (int i = 0; i < 32; ++i) {
      if (i < warp) before += sums[i];
      total += sums[i];
    }
    if (cell < k) first_task[cell] = inside(before + running - tasks);
    carry += total;
    __syncthreads();  // the sums are read by all
  }
  if (threadIdx.x == 0) first_task[k] = inside(carry);
}

}  // namespace voronerf
