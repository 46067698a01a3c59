// Small kernels, each right or with one bug of a kind that the emulation is there to find; `bug` 0 is the right one.
#include "common/cuda_wrappers.h"

namespace {

enum Bug {
  kRight,
  kNoBarrier,          // reads what another thread writes with no __syncthreads between
  kNoWarpBarrier,      // the same within a warp, with no __syncwarp
  kDivergentBarrier,   // half of the block leaves out a barrier
  kDivergentShuffle,   // a lane leaves out a shuffle
  kPastTheEnd,         // writes behind the dynamic shared memory
  kPastTheOutput,      // writes behind the output
  kUnwritten,          // reads shared memory that nobody wrote
  kPlainIncrement,     // adds to one counter from all threads without an atomic
  kBlocksMeet,         // two blocks write the same element
  kBarrierTooSoon,     // writes for the next round while the last one is being read
  kShuffleForBarrier,  // a shuffle in the place of __syncwarp, which orders no memory
};

// out[i] of a block: three times the sum of the values of all its threads, taken in two rounds through shared memory.
__global__ void planted_kernel(const float* values, float* out, int* counter, int bug) {
  VN_DYN_SHARED(float, staged);
  const int i = threadIdx.x, threads = blockDim.x;
  float sum = 0.0f;
  for (int round = 0; round < 2; ++round) {
    if (!(bug == kUnwritten && i == 3)) staged[i] = (round + 1) * values[blockIdx.x * threads + i];
    if (bug == kPastTheEnd && i == threads - 1) staged[threads] = 1.0f;
    if (!(bug == kNoBarrier || (bug == kDivergentBarrier && i < threads / 2))) __syncthreads();
    for (int j = 0; j < threads; ++j) sum += staged[j];
    if (bug != kBarrierTooSoon) __syncthreads();
    if (bug == kBarrierTooSoon) staged[i] = 0.0f;
  }
  // The right neighbour's value, within the warp.
  staged[i] = values[blockIdx.x * threads + i];
  if (bug == kShuffleForBarrier) {
    __shfl_sync(0xffffffffu, i, 0);
  } else if (bug != kNoWarpBarrier) {
    __syncwarp();
  }
  const float neighbour = staged[i / 32 * 32 + (i + 1) % 32];
  float shuffled = neighbour;
  if (!(bug == kDivergentShuffle && i == 5))
    shuffled = __shfl_sync(0xffffffffu, values[blockIdx.x * threads + i], i + 1);
  if (bug == kPlainIncrement) {
    *counter = *counter + 1;
  }
  if (bug == kBlocksMeet && i == 0) *counter = static_cast<int>(blockIdx.x);
  out[blockIdx.x * threads + i] = sum + neighbour - shuffled;
  if (bug == kPastTheOutput && blockIdx.x == gridDim.x - 1 && i == threads - 1) out[(blockIdx.x + 1) * threads] = 1.0f;
}

}  // namespace

void planted(const float* values, float* out, int* counter, int blocks, int threads, int bug) {
  VN_LAUNCH(planted_kernel, blocks, threads, sizeof(float) * threads, nullptr, values, out, counter, bug);
}
