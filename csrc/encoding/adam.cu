// Adam on CUDA: one thread per entry. Neighbouring threads have neighbouring entries, so that a warp reads a whole line
// of gradients and, in the other three arrays, only the sectors with a nonzero gradient.
//
// A training step is two launches per 36 parameters and reads nothing on the host. In the first launch, blocks check
// runs of the networks' gradients, and each writes one vote: whether it has found NaN or a number that is too large.
// Block 0 votes on the loss and computes the bias-corrected rates. In the second launch, each block updates a run of
// one parameter, unless a vote says that the step is skipped; one thread writes the guard. A vote has one writer and is
// read only in a later launch, so that no operation is atomic and no memory needs clearing. With more parameters, all
// launches of the first kind come before all launches of the second kind, and their votes accumulate.
#include <algorithm>

#include "common/cuda_wrappers.h"
#include "encoding/adam.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kRun = 4 * kThreads;  // entries that a block updates
constexpr int kJudgeThreads = 1024;
constexpr int kJudgedRun = 4 * kJudgeThreads;  // entries that a block checks at a time
constexpr int kVotes = 128;                    // most voting blocks: each warp of the update reads all votes
constexpr int kMost = 36;                      // parameters of a launch: their pointers must fit its 4 KB of arguments

__device__ __forceinline__ void update_entry(const AdamStep& rule, float g, float* parameter, float* mean,
                                             float* square, int64_t i) {
  const float m = rule.decay * mean[i] + rule.fresh * g;
  const float v = rule.decay_sq * square[i] + rule.fresh_sq * (g * g);
  mean[i] = m;
  square[i] = v;
  parameter[i] -= rule.step_size * (m / (sqrtf(v) + rule.epsilon));
}

struct AdamTensor {
  const float* gradient;
  float *parameter, *mean, *square;
  int64_t n;
  AdamRule rule;
  unsigned first;   // first block of the update
  unsigned judged;  // first run to check; tables have no such runs
};
struct AdamTensors {
  AdamTensor of[kMost];
  int count;
  unsigned judged;  // runs to check, of all tensors
};
static_assert(sizeof(AdamTensors) <= 3900, "arguments of a launch");

// Block 0 computes the bias-corrected rates and checks the loss. The other blocks share the runs of parameters and
// check their gradients. A launch that is not the `first` keeps the votes of earlier launches.
__global__ void __launch_bounds__(kJudgeThreads)
    adam_judge_kernel(AdamTensors tensors, AdamGuard guard, float* corrected, float* votes, bool first) {
  const int thread = static_cast<int>(threadIdx.x);
  bool large = false;
  if (blockIdx.x == 0) {
    if (thread < tensors.count) {
      const AdamRule& rule = tensors.of[thread].rule;
      const double step = static_cast<double>(*rule.step) + 1.0, root = sqrt(1.0 - pow(rule.decay_sq, step));
      const double rate = rule.rate_at == nullptr ? rule.rate : *rule.rate_at;
      corrected[2 * thread] = static_cast<float>(rate * root / (1.0 - pow(rule.decay, step)));
      corrected[2 * thread + 1] = static_cast<float>(rule.epsilon * root);
    }
    large = guard.loss != nullptr && !(fabsf(*guard.loss) < guard.limit);
  }
  int number = 0;
  for (unsigned run = blockIdx.x - 1; blockIdx.x != 0 && run < tensors.judged; run += gridDim.x - 1) {
    while (number + 1 < tensors.count && run >= tensors.of[number + 1].judged) ++number;
    const AdamTensor& tensor = tensors.of[number];
    const int64_t begin = static_cast<int64_t>(run - tensor.judged) * kJudgedRun + thread;
#pragma unroll
    for (int part = 0; part < kJudgedRun / kJudgeThreads; ++part) {
      const int64_t i = begin + part * kJudgeThreads;
      if (i < tensor.n) large |= !(fabsf(tensor.gradient[i]) < guard.limit);
    }
  }
  VN_SHARED(of_warps, unsigned[kJudgeThreads / 32]);
  const unsigned of_warp = __ballot_sync(kAllLanes, large);
  if (thread % 32 == 0) of_warps[thread / 32] = of_warp;
  __syncthreads();
  if (thread != 0) return;
  float vote = first ? 0.0f : votes[blockIdx.x];
  for (unsigned lanes : of_warps) vote = lanes != 0 ? 1.0f : vote;
  votes[blockIdx.x] = vote;
}

// Returns whether the step is skipped. If the guard has a loss, the `count` votes decide, otherwise the guard's flag
// `skip`. The result is the same for all threads.
__device__ __forceinline__ bool is_skipped(const AdamGuard& guard, const float* votes, int count) {
  if (guard.loss == nullptr) return guard.skip != nullptr && *guard.skip != 0.0f;
  bool voted = false;
  for (int i = static_cast<int>(threadIdx.x) % 32; i < count; i += 32) voted |= votes[i] != 0.0f;
  return __ballot_sync(kAllLanes, voted) != 0;
}

// The `last` launch of a step writes the guard. If the guard has a loss, all blocks decide by the votes, so that no
// block reads the guard's flag while one block writes it.
__global__ void __launch_bounds__(kThreads)
    adam_kernel(AdamTensors tensors, AdamGuard guard, const float* __restrict__ corrected,
                const float* __restrict__ votes, int count, bool last) {
  const bool skipped_step = is_skipped(guard, votes, count);
  if (last && guard.loss != nullptr && blockIdx.x == 0 && threadIdx.x == 0) {
    const float flag = skipped_step ? 1.0f : 0.0f;
    *guard.skip = flag;
    *guard.skipped += flag;
    *guard.in_a_row = (*guard.in_a_row + 1.0f) * flag;
  }
  if (skipped_step) return;
  int number = 0;
  while (number + 1 < tensors.count && blockIdx.x >= tensors.of[number + 1].first) ++number;
  const AdamTensor& tensor = tensors.of[number];
  const AdamStep rule{corrected[2 * number],
                      static_cast<float>(tensor.rule.decay),
                      static_cast<float>(tensor.rule.decay_sq),
                      static_cast<float>(1.0 - tensor.rule.decay),
                      static_cast<float>(1.0 - tensor.rule.decay_sq),
                      corrected[2 * number + 1],
                      tensor.rule.dense};
  const float scale = guard.scale == nullptr ? 1.0f : *guard.scale;
  const unsigned block = blockIdx.x - tensor.first;
  for (int part = 0; part < kRun / kThreads; ++part) {
    const int64_t i = static_cast<int64_t>(block) * kRun + part * kThreads + threadIdx.x;
    if (i >= tensor.n) break;
    const float g = tensor.gradient[i];
    if (rule.dense || g != 0.0f) update_entry(rule, g / scale, tensor.parameter, tensor.mean, tensor.square, i);
  }
  // adam_judge_kernel has read this step count already.
  if (block == 0 && threadIdx.x == 0) *tensor.rule.step += 1.0f;
}

}  // namespace

int64_t adam_workspace_cuda(int64_t count) { return kVotes + 2 * count; }

void adam_cuda(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
               float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
               float* workspace, void* stream) {
  const size_t count = rules.size();
  const auto for_each_launch = [&](const auto& run) {
    for (size_t begin = 0; begin < count; begin += kMost) {
      const size_t end = std::min<size_t>(count, begin + kMost);
      AdamTensors tensors{};
      unsigned blocks = 0;
      for (size_t i = begin; i < end; ++i) {
        AdamTensor& tensor = tensors.of[tensors.count++];
        tensor = {gradients[i], parameters[i], means[i], squares[i], sizes[i], rules[i], blocks, tensors.judged};
        blocks += static_cast<unsigned>(ceil_div<int64_t>(std::max<int64_t>(sizes[i], 1), kRun));
        if (guard.loss != nullptr && rules[i].dense) {
          tensors.judged += static_cast<unsigned>(ceil_div<int64_t>(sizes[i], kJudgedRun));
        }
      }
      run(tensors, blocks, workspace + kVotes + 2 * begin, begin == 0, end == count);
    }
  };
  unsigned judged = 0;  // the most of any launch: all launches have the same number of votes
  for_each_launch([&](const AdamTensors& tensors, auto...) { judged = std::max(judged, tensors.judged); });
  const unsigned votes = 1 + std::min<unsigned>(judged, kVotes - 1);
  for_each_launch([&](const AdamTensors& tensors, unsigned, float* corrected, bool first, bool) {
    VN_LAUNCH(adam_judge_kernel, votes, kJudgeThreads, 0, stream, tensors, guard, corrected, workspace, first);
  });
  for_each_launch([&](const AdamTensors& tensors, unsigned blocks, float* corrected, bool, bool last) {
    VN_LAUNCH(adam_kernel, blocks, kThreads, 0, stream, tensors, guard, corrected, workspace, static_cast<int>(votes),
              last);
  });
}

}  // namespace voronerf
