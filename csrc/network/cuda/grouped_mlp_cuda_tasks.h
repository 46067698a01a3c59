// The map from blocks to rows of cells, which the device makes, so that the host does not read the offsets, and what
// else precedes a network: kernels that pack weights have more blocks for it.
#pragma once

#include "network/cuda/grouped_mlp_cuda_tile.h"

namespace voronerf {

constexpr int kScanThreads = 1024;

// first_task [k+1] by one block of kThreads: the running sum of tasks_of(cell). Cells that overlap, which offsets
// that fall make, could have more tasks than `most`, what the grid has blocks for and the workspace partials: no number
// exceeds it, and what such cells get is undefined.
template <int kThreads, typename Tasks>
__device__ void number_tasks(int64_t k, int64_t most, int32_t* first_task, const Tasks& tasks_of) {
  VN_SHARED(sums, int64_t[kThreads / 32]);
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const auto inside = [most](int64_t tasks) { return static_cast<int32_t>(tasks < most ? tasks : most); };
  int64_t carry = 0;
  for (int64_t start = 0; start < k; start += kThreads) {
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
    for (int i = 0; i < kThreads / 32; ++i) {
      if (i < warp) before += sums[i];
      total += sums[i];
    }
    if (cell < k) first_task[cell] = inside(before + running - tasks);
    carry += total;
    __syncthreads();  // the sums are read by all
  }
  if (threadIdx.x == 0) first_task[k] = inside(carry);
}

// The same for tasks of so many rows of every cell.
template <int kThreads>
__device__ void mlp_number_tasks(const MlpCudaData& data, int64_t task_rows, int64_t tasks) {
  number_tasks<kThreads>(data.k, tasks, data.first_task, [&](int64_t cell) {
    return static_cast<int32_t>(ceil_div(mlp_cell_rows(data, cell), task_rows));
  });
}

// What precedes a network beside the packing of weights, by the blocks of the first layer in a grid (k, layers, blocks
// of a layer): they clear the strays, and one of them numbers the tasks.
__device__ inline void mlp_prepare_rows(const MlpCudaData& data, int64_t task_rows, int64_t tasks,
                                        const MlpStrays& strays) {
  const int64_t block = blockIdx.x + static_cast<int64_t>(blockIdx.z) * gridDim.x;
  const int64_t blocks = static_cast<int64_t>(gridDim.x) * gridDim.z;
  if (block == 0) mlp_number_tasks<kMlpLayerThreads>(data, task_rows, tasks);
  if (strays.rows[0] == nullptr && strays.rows[1] == nullptr) return;
  const int64_t low = mlp_cell_begin(data, 0), last = data.offsets[data.k];
  const int64_t high = last < low ? low : last > data.n ? data.n : last;
  for (int64_t i = block * kMlpLayerThreads + threadIdx.x; i < data.n - (high - low); i += blocks * kMlpLayerThreads) {
    const int64_t row = mlp_source_row(data, i < low ? i : i + high - low);
#pragma unroll
    for (int each = 0; each < 2; ++each) {
      if (strays.rows[each] == nullptr) continue;
      const int width = strays.widths[each];
      for (int column = 0; column < width; ++column) strays.rows[each][row * width + column] = 0.0f;
    }
  }
}

}  // namespace voronerf
