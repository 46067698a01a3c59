// A small kernel, correct (`bug` 0) or with one planted bug that the emulation must find.
#include "common/cuda_wrappers.h"

namespace {

enum Bug {
  kRight,
  kNoBarrier,          // no __syncthreads between one thread's write and another's read
  kNoWarpBarrier,      // no __syncwarp between a write and a read in a warp
  kDivergentBarrier,   // half of the block skips a barrier
  kDivergentShuffle,   // a lane skips a shuffle
  kPastTheEnd,         // writes past the end of dynamic shared memory
  kPastTheOutput,      // writes past the end of the output
  kUnwritten,          // reads uninitialised shared memory
  kPlainIncrement,     // all threads increment one counter without an atomic
  kBlocksMeet,         // two blocks write the same element
  kBarrierTooSoon,     // overwrites values that other threads still read
  kShuffleForBarrier,  // a shuffle instead of __syncwarp, which does not order memory
  kWarpForBlock,       // __syncwarp instead of __syncthreads between a write and another warp's read
};

// Writes to out[i] three times the sum of the block's values, computed in two rounds through shared memory.
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
  // Reads the right neighbour's value within the warp.
  staged[i] = values[blockIdx.x * threads + i];
  if (bug == kShuffleForBarrier) {
    __shfl_sync(0xffffffffu, i, 0);
  } else if (bug != kNoWarpBarrier) {
    __syncwarp();
  }
  const float neighbour = staged[i / 32 * 32 + (i + 1) % 32];
  // Reads the value of the next warp.
  if (bug == kWarpForBlock) {
    __syncwarp();
  } else {
    __syncthreads();
  }
  const int other = (i + 32) % threads;
  const float difference = staged[other] - values[blockIdx.x * threads + other];
  float shuffled = neighbour;
  if (!(bug == kDivergentShuffle && i == 5))
    shuffled = __shfl_sync(0xffffffffu, values[blockIdx.x * threads + i], i + 1);
  if (bug == kPlainIncrement) {
    *counter = *counter + 1;
  }
  if (bug == kBlocksMeet && i == 0) *counter = static_cast<int>(blockIdx.x);
  out[blockIdx.x * threads + i] = sum + neighbour - shuffled + difference;
  if (bug == kPastTheOutput && blockIdx.x == gridDim.x - 1 && i == threads - 1) out[(blockIdx.x + 1) * threads] = 1.0f;
}

}  // namespace

void planted(const float* values, float* out, int* counter, int blocks, int threads, int bug) {
  VN_LAUNCH(planted_kernel, blocks, threads, sizeof(float) * threads, nullptr, values, out, counter, bug);
}
