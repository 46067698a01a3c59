// Updates an occupancy grid from samples on CUDA, one thread per sample, in three launches: one sample claims each
// voxel, the voxel's density decays, and all of its samples raise it. Densities are not negative, so their bits sort
// like integers and their sign bits are free: the first sample to set a voxel's sign bit claims the voxel. No two
// threads store to the same place.
#include "common/cuda_wrappers.h"
#include "rays/observe_occupancy_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;
constexpr unsigned kSign = 0x80000000u;

__device__ __forceinline__ int64_t this_sample() { return static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; }

// cells: the samples' voxels, -1 for no update. before: the old density of a claimed voxel; -1 if none is claimed.
__global__ void __launch_bounds__(kThreads)
    claim_kernel(ObservedSamples in, unsigned* density, int32_t* __restrict__ cells, float* __restrict__ before) {
  const int64_t i = this_sample();
  if (i >= in.m) return;
  const int64_t cell = observed_cell(in, i);
  cells[i] = observes(in, i, cell) ? static_cast<int32_t>(cell) : -1;
  if (cells[i] < 0) return;
  const unsigned bits = atomicOr(density + cell, kSign);
  float previous;
  memcpy(&previous, &bits, sizeof previous);
  before[i] = (bits & kSign) != 0 ? -1.0f : previous;
}

__global__ void __launch_bounds__(kThreads)
    fade_kernel(ObservedSamples in, const int32_t* __restrict__ cells, const float* __restrict__ before,
                float* __restrict__ density, uint8_t* __restrict__ occupied) {
  const int64_t i = this_sample();
  if (i >= in.m || cells[i] < 0 || before[i] < 0.0f) return;
  const float faded = before[i] * in.decay;
  density[cells[i]] = faded;
  occupied[cells[i]] = faded >= in.threshold;
}

__global__ void __launch_bounds__(kThreads)
    raise_kernel(ObservedSamples in, const int32_t* __restrict__ cells, int* density, uint8_t* __restrict__ occupied) {
  const int64_t i = this_sample();
  if (i >= in.m || cells[i] < 0) return;
  const float seen = observed_density(in, i);
  int bits;
  memcpy(&bits, &seen, sizeof bits);
  const int old = atomicMax(density + cells[i], bits);
  float previous;
  memcpy(&previous, &old, sizeof previous);
  // At most one sample of a voxel writes here.
  if (seen >= in.threshold && !(previous >= in.threshold)) occupied[cells[i]] = 1;
}

}  // namespace

void observe_occupancy_cuda(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                            void* stream) {
  if (in.m == 0) return;
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(in.m, kThreads));
  VN_LAUNCH(claim_kernel, blocks, kThreads, 0, stream, in, reinterpret_cast<unsigned*>(density), cells, before);
  VN_LAUNCH(fade_kernel, blocks, kThreads, 0, stream, in, cells, before, density, occupied);
  VN_LAUNCH(raise_kernel, blocks, kThreads, 0, stream, in, cells, reinterpret_cast<int*>(density), occupied);
}

}  // namespace voronerf
