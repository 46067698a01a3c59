// Who multiplies in the chained network: a warp by itself, mma.sync, or four of them together, wgmma. Either way a warp
// has 32 rows as two row tiles; those of four warps are two products of 64 rows. Both take the same packed weights.
#pragma once

#include "network/cuda/cuda_wgmma.h"
#include "network/cuda/grouped_mlp_cuda_chain_tile.h"

namespace voronerf {

// Sums are available at once.
template <bool kHalf>
struct ChainWarps {
  static constexpr bool kBfloat16 = kHalf, kGroups = false;
  static constexpr int kWarps = 1;  // that multiply together

  // Where a lane reads a piece's weights.
  using Weights = const unsigned char*;
  static __device__ __forceinline__ Weights weights(const unsigned char* piece) {
    return piece + threadIdx.x % 32 * 16;
  }
  static __device__ __forceinline__ void advance(Weights& weights, int bytes) { weights += bytes; }

  // Other threads are about to multiply what this thread copied to shared memory.
  static __device__ __forceinline__ void publish() {}

  // sums += held weights^T for the first `steps` steps, all where kAll says so.
  template <bool kAll, int kTiles, int kSteps>
  static __device__ __forceinline__ void multiply(MlpSums<2, kTiles>& sums, MlpFragment (&held)[kSteps], int steps,
                                                  Weights weights) {
#pragma unroll
    for (int step = 0; step < kSteps; ++step) {
      if (kAll || step < steps) {
        chain_multiply<kBfloat16>(sums, held[step], weights + step * chain_pairs(kTiles) * kChainQuad);
      }
    }
  }
};

// run(number of steps, as a constant), of 1 to kMost.
template <int kMost, typename Run>
__device__ __forceinline__ void chain_with_steps(int steps, const Run& run) {
  if constexpr (kMost == 1) {
    run(std::integral_constant<int, 1>());
  } else if (steps == kMost) {
    run(std::integral_constant<int, kMost>());
  } else {
    chain_with_steps<kMost - 1>(steps, run);
  }
}

// A piece's weights are what wgmma takes without swizzling as they are: core matrices for 8 columns more are the next
// 128 bytes, those for 8 outputs more 256 bytes on. Sums are waited for where they are multiplied, in one run of code
// without branches, since the compiler gives up products side by side otherwise.
template <bool kHalf>
struct ChainGroups {
  static constexpr bool kBfloat16 = kHalf, kGroups = true;
  static constexpr int kWarps = kGroupThreads / 32;

  using Weights = uint64_t;
  static __device__ __forceinline__ Weights weights(const unsigned char* piece) {
    return group_matrix(piece, kChainQuad / 4, kChainQuad / 2);
  }
  static __device__ __forceinline__ void advance(Weights& weights, int bytes) { weights += bytes / 16; }

  static __device__ __forceinline__ void publish() { group_publish(); }

  template <bool kAll, int kTiles, int kSteps>
  static __device__ __forceinline__ void multiply(MlpSums<2, kTiles>& sums, MlpFragment (&held)[kSteps], int steps,
                                                  Weights weights) {
    if constexpr (kAll || kSteps == 1) {
      multiply_first<kSteps>(sums, held, weights);
    } else {
      chain_with_steps<kSteps - 1>(steps,
                                   [&](auto count) { multiply_first<decltype(count)::value>(sums, held, weights); });
    }
  }

  // The same for all steps, and the sums rounded to be held in their turn: those of the first row tile while the second
  // is multiplied.
  template <bool kRelu, int kTiles, int kSteps>
  static __device__ __forceinline__ void multiply_round(MlpSums<2, kTiles>& sums, MlpFragment (&held)[kSteps],
                                                        Weights weights) {
    begin<kSteps>(sums, held, weights);
    group_wait<1>();
    group_settle(sums[0]);
    chain_round_row<kBfloat16, kRelu, 0>(sums, held);
    group_wait<0>();
    group_settle(sums[1]);
    chain_round_row<kBfloat16, kRelu, 1>(sums, held);
  }

 private:
  template <int kCount, int kTiles, int kSteps>
  static __device__ __forceinline__ void multiply_first(MlpSums<2, kTiles>& sums, MlpFragment (&held)[kSteps],
                                                        Weights weights) {
    begin<kCount>(sums, held, weights);
    group_wait<0>();
    group_settle(sums[0]);
    group_settle(sums[1]);
  }

  template <int kCount, int kTiles, int kSteps>
  static __device__ __forceinline__ void begin(MlpSums<2, kTiles>& sums, MlpFragment (&held)[kSteps], Weights weights) {
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      group_settle(sums[r]);
#pragma unroll
      for (int step = 0; step < kCount; ++step) group_settle(held[step][r]);
    }
    group_fence();
#pragma unroll
    for (int r = 0; r < 2; ++r) {
#pragma unroll
      for (int step = 0; step < kCount; ++step) {
        group_multiply<kBfloat16>(sums[r], held[step][r], weights + step * chain_pairs(kTiles) * kChainQuad / 16);
      }
      group_commit();
    }
  }
};

}  // namespace voronerf
