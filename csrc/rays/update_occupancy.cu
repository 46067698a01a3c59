// Updates an occupancy grid on CUDA, in three launches: all cells keep what they have, the named ones fade from that,
// and the values raise them. A cell that is named more than once is stored by atomic operations.
#include <algorithm>

#include "common/cuda_wrappers.h"
#include "rays/update_occupancy.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;

__device__ __forceinline__ int64_t this_thread() {
  return static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
}

__global__ void __launch_bounds__(kThreads)
    fade_kernel(const float* __restrict__ density, const int32_t* __restrict__ rows, float* result, int64_t n,
                int64_t q, float decay) {
  const int64_t i = this_thread();
  if (i >= q || rows[i] < 0 || rows[i] >= n) return;
  atomicExch(result + rows[i], density[rows[i]] * decay);
}

// Bits of floats have the order of integers from 0 on, and the opposite one below.
__global__ void __launch_bounds__(kThreads)
    raise_kernel(const int32_t* __restrict__ rows, const float* __restrict__ values, float* result, int64_t n,
                 int64_t q) {
  const int64_t i = this_thread();
  if (i >= q || rows[i] < 0 || rows[i] >= n) return;
  int bits;
  memcpy(&bits, values + i, sizeof bits);
  if (bits >= 0) {
    atomicMax(reinterpret_cast<int*>(result) + rows[i], bits);
  } else {
    atomicMin(reinterpret_cast<unsigned*>(result) + rows[i], static_cast<unsigned>(bits));
  }
}

__global__ void __launch_bounds__(kThreads)
    occupied_kernel(const float* __restrict__ result, uint8_t* __restrict__ occupied, int64_t n, float threshold) {
  const int64_t i = this_thread();
  if (i < n) occupied[i] = result[i] >= threshold;
}

unsigned blocks_of(int64_t threads) {
  return static_cast<unsigned>(ceil_div<int64_t>(threads, kThreads));
}

}  // namespace

void update_occupancy_cuda(const float* density, const int32_t* rows, const float* values, float* result,
                           uint8_t* occupied, int64_t n, int64_t q, float decay, float threshold, void* stream) {
  if (n == 0) return;
  VN_CUDA_CHECK(
      cudaMemcpyAsync(result, density, sizeof(float) * n, cudaMemcpyDeviceToDevice, static_cast<cudaStream_t>(stream)));
  if (q > 0) {
    VN_LAUNCH(fade_kernel, blocks_of(q), kThreads, 0, stream, density, rows, result, n, q, decay);
    VN_LAUNCH(raise_kernel, blocks_of(q), kThreads, 0, stream, rows, values, result, n, q);
  }
  VN_LAUNCH(occupied_kernel, blocks_of(n), kThreads, 0, stream, result, occupied, n, threshold);
}

}  // namespace voronerf
