// Device functions for CUDA kernels with one warp per ray: its samples, 32 at a time, and sums over them.
#pragma once

#include "common/cuda_wrappers.h"

namespace voronerf {

constexpr float kOpaque = 1e30f;  // replaces infinite density; just as opaque over any length but 0

// Caps a density at kOpaque; NaN stays NaN.
__device__ inline float finite_density(float sigma) { return sigma > kOpaque ? kOpaque : sigma; }

// A compensated sum in two floats.
struct Carry {
  float high = 0.0f, low = 0.0f;

  __device__ float plus(float x) const { return high + (low + x); }
  __device__ void add(float x) {
    const float sum = high + x, part = sum - high;
    const float lost = (high - (sum - part)) + (x - part);
    high = sum;
    // Infinity and NaN have no rounding error to keep.
    if (lost == lost && fabsf(lost) < INFINITY) low += lost;
  }
};

__device__ inline float sum_of_lanes(float x) {
  for (int step = 16; step > 0; step /= 2) x += __shfl_xor_sync(kAllLanes, x, step);
  return x;
}

// `running_sum` returns the sum over this lane and the lanes before it, `running_sum_back` the sum over this lane and
// the lanes after it.
template <typename T>
__device__ T running_sum(T x, int lane) {
  for (int step = 1; step < 32; step *= 2) {
    const T other = __shfl_up_sync(kAllLanes, x, step);
    if (lane >= step) x += other;
  }
  return x;
}

__device__ inline float running_sum_back(float x, int lane) {
  for (int step = 1; step < 32; step *= 2) {
    const float other = __shfl_down_sync(kAllLanes, x, step);
    if (lane + step < 32) x += other;
  }
  return x;
}

// Returns the sum over the threads of a block to thread 0. `sums` is shared, one entry per thread.
template <int kThreads>
__device__ double sum_of_block(double sum, double* sums) {
  sums[threadIdx.x] = sum;
  for (unsigned half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) sums[threadIdx.x] += sums[threadIdx.x + half];
  }
  return sums[threadIdx.x];
}

// Returns the optical depth in front of each lane's sample. The carry advances to the end of the chunk.
__device__ inline float depth_in_front(float optical, int lane, Carry& carry) {
  const float through = running_sum(optical, lane);
  float before = __shfl_up_sync(kAllLanes, through, 1);
  if (lane == 0) before = 0.0f;
  const float front = carry.plus(before);
  carry.add(__shfl_sync(kAllLanes, through, 31));
  return front;
}

// Returns the sum of `share`, a sample's weight times the gradient with respect to the weight, over the samples behind
// each lane's sample. The sum is subtracted in the gradient of the optical depth of the lane's sample. Lanes without a
// sample have share 0. The carry moves to the front of the chunk.
__device__ inline float share_behind(float share, int lane, Carry& carry) {
  const float rest = running_sum_back(share, lane);
  float after = __shfl_down_sync(kAllLanes, rest, 1);
  if (lane == 31) after = 0.0f;
  const float behind = carry.plus(after);
  carry.add(__shfl_sync(kAllLanes, rest, 0));
  return behind;
}

struct RayRange {
  int64_t begin, end;
};

// Returns the samples of a ray. Offsets that decrease or exceed m cannot be rejected without a host read; they are
// clamped, so that no access is out of range.
__device__ inline RayRange ray_range(const int32_t* offsets, int64_t ray, int64_t m) {
  const int64_t first = offsets[ray], last = offsets[ray + 1];
  const int64_t begin = first < 0 ? 0 : first > m ? m : first;
  return {begin, last < begin ? begin : last > m ? m : last};
}

}  // namespace voronerf
