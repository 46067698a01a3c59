// One product of a group of four warps over several steps of 16, right or with one bug of a kind that the emulation is
// there to find (emulation_groups.h).
#include "network/cuda/cuda_wgmma.h"
#include "group_product.h"

namespace {

using namespace voronerf;

enum Bug {
  kRight,
  kSwapped,         // the two offsets of the descriptor
  kNoWait,          // never waits
  kReadTooSoon,     // reads the sums before it waits
  kWaitTooLittle,   // for all sets but the last
  kNoFence,         // before the first product
  kFenceTooSoon,    // before the sums are there
  kUnpublished,     // what was copied to shared memory
  kNoBarrier,       // reads what other warps copy
  kOperandChanged,  // while the product is under way
  kSumsChanged,     // likewise
  kMatrixChanged,   // likewise, by a thread after the barrier
  kOtherMatrix,     // of one warp
  kLeftOut,         // the last product, by one warp
  kPastTheEnd,      // a matrix of which the end lies behind the shared memory
  kMisaligned,      // a matrix
  kTwoShapes,       // share sums
  kNotSettled,      // the left operand
};

// out [64 groups][8 kTiles] += a [64 groups][16 steps] b [8 kTiles][16 steps]^T; `packed`: b as it is to lie in shared
// memory, `bytes` in all and step_bytes from step to step.
template <bool kBfloat16, int kTiles>
__global__ void group_product_kernel(const GroupProductCase given) {
  VN_DYN_SHARED(unsigned char, shared);
  const int bug = given.bug, warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  for (int at = 16 * threadIdx.x; at < given.bytes; at += 16 * blockDim.x)
    copy_async(shared + at, given.packed + at, true);
  copy_commit();
  copy_wait<0>();
  if (bug != kUnpublished) group_publish();
  if (bug != kNoBarrier) __syncthreads();
  const int row = warp * 16 + lane / 4, column = 2 * (lane % 4), k = 16 * given.steps;
  float sums[kTiles][4];
  if (bug == kFenceTooSoon) group_settle(sums), group_fence();
  for (int i = 0; i < 4 * kTiles; ++i) {
    sums[i / 4][i % 4] = given.out[(row + 8 * (i / 2 % 2)) * 8 * kTiles + i / 4 * 8 + column + i % 2];
  }
  uint32_t a[kGroupSteps][4];
  for (int step = 0; step < given.steps; ++step) {
    for (int i = 0; i < 4; ++i) {
      const uint16_t* pair = given.a + (row + 8 * (i % 2)) * k + 16 * step + column + 8 * (i / 2);
      a[step][i] = pair[0] | static_cast<uint32_t>(pair[1]) << 16;
    }
    if (bug != kNotSettled) group_settle(a[step]);
  }
  if (bug != kFenceTooSoon) group_settle(sums);
  if (bug != kNoFence && bug != kFenceTooSoon) group_fence();
  if (bug == kFenceTooSoon) group_settle(sums);
  for (int step = 0; step < given.steps; ++step) {
    if (bug == kLeftOut && warp == 1 && step == given.steps - 1) break;
    const unsigned char* matrix = shared + step * given.step_bytes;
    if (bug == kPastTheEnd && step == given.steps - 1) matrix += 128;
    if (bug == kMisaligned) matrix += 8;
    if (bug == kOtherMatrix && warp == 2) matrix = shared;
    const bool swapped = bug == kSwapped;
    const uint64_t b =
        group_matrix(matrix, swapped ? given.stride : given.leading, swapped ? given.leading : given.stride);
    group_multiply<kBfloat16>(sums, a[step], b);
    if (bug == kTwoShapes) {
      auto& half = reinterpret_cast<float (&)[1][4]>(sums);
      group_multiply<kBfloat16>(half, a[step], b);
    }
    group_commit();
    if (bug == kOperandChanged) a[step][1] ^= 1;
  }
  if (bug == kSumsChanged) sums[0][1] = 1.0f;
  if (bug == kMatrixChanged) {
    __syncthreads();
    if (threadIdx.x == 0) shared[0] ^= 0x7f;
    __syncthreads();
  }
  if (bug == kReadTooSoon) {
    const float first = sums[0][0];
    group_wait<0>();
    sums[0][0] = first;
  } else if (bug == kWaitTooLittle) {
    group_wait<1>();
  } else if (bug != kNoWait) {
    group_wait<0>();
  }
  if (bug == kRight) group_settle(sums);
  for (int i = 0; i < 4 * kTiles; ++i) {
    given.out[(row + 8 * (i / 2 % 2)) * 8 * kTiles + i / 4 * 8 + column + i % 2] = sums[i / 4][i % 4];
  }
}

}  // namespace

void group_product(const GroupProductCase& given, int threads, int tiles, bool bfloat16) {
  const auto run = [&](auto count) {
    constexpr int kTiles = decltype(count)::value;
    if (bfloat16) {
      VN_LAUNCH((group_product_kernel<true, kTiles>), 1, threads, given.bytes, nullptr, given);
    } else {
      VN_LAUNCH((group_product_kernel<false, kTiles>), 1, threads, given.bytes, nullptr, given);
    }
  };
  if (tiles == 1) run(std::integral_constant<int, 1>());
  if (tiles == 2) run(std::integral_constant<int, 2>());
  if (tiles == 4) run(std::integral_constant<int, 4>());
  if (tiles == 8) run(std::integral_constant<int, 8>());
}
