// Adam on CUDA, a thread an entry. Neighbouring threads have neighbouring entries: a warp reads its whole line of
// gradients, and of the other three arrays only the sectors that have one.
//
// A step of a training is two launches for 36 parameters, and reads nothing on the host. In the first, blocks look at
// runs of the gradients of the networks, and each of them writes one vote: whether it has found a number that is too
// large, or none. One more block votes on the loss, and corrects the rates. In the second, a block updates a run of one
// parameter, unless a vote says that the step is left out; one thread writes the guard. A vote has one writer and is
// read in a later launch alone, so that no operation is atomic, and no memory has to be cleared. With more parameters
// there are as many launches of the first kind, whose votes add up, before those of the second.
#include <algorithm>

#include "common/cuda_wrappers.h"
#include "encoding/adam.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kRun = 4 * kThreads;  // entries of a block
constexpr int kJudgeThreads = 1024;
constexpr int kJudgedRun = 4 * kJudgeThreads;  // entries that a block looks at before it goes on
constexpr int kVotes = 128;                    // blocks that vote at most: each warp of the update reads all votes
constexpr int kMost = 36;  // parameters of a launch: their pointers are its arguments, of which 4 KB fit

__device__ __forceinline__ void update_entry(const AdamStep& rule, float g, float* parameter, float* mean,
                                             float* square, int64_t i) {
  const float m = rule.decay * mean[i] + (1.0f - rule.decay) * g;
  const float v = rule.decay_sq * square[i] + (1.0f - rule.decay_sq) * (g * g);
  mean[i] = m;
  square[i] = v;
  parameter[i] -= rule.step_size * (m / (sqrtf(v) + rule.epsilon));
}

struct AdamTensor {
  const float* gradient;
  float *parameter, *mean, *square;
  int64_t n;
  AdamRule rule;
  unsigned first;   // block of the update
  unsigned judged;  // first run that is looked at; of a table there is none
};
struct AdamTensors {
  AdamTensor of[kMost];
  int count;
  unsigned judged;  // runs of all of them
};
static_assert(sizeof(AdamTensors) <= 3900, "arguments of a launch");

// Block 0 corrects the rates and looks at the loss; the threads of another block look at a run of one parameter, then
// at another run. A launch that is not the `first` keeps the votes of the launches before.
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
  for (unsigned each : of_warps) vote = each != 0 ? 1.0f : vote;
  votes[blockIdx.x] = vote;
}

// Whether the step is left out, which `count` votes say where there is a loss; the same for all threads.
__device__ __forceinline__ bool is_left_out(const AdamGuard& guard, const float* votes, int count) {
  if (guard.loss == nullptr) return guard.found != nullptr && *guard.found != 0.0f;
  bool found = false;
  for (int i = static_cast<int>(threadIdx.x) % 32; i < count; i += 32) found |= votes[i] != 0.0f;
  return __ballot_sync(kAllLanes, found) != 0;
}

// The `last` of the launches for all parameters writes the guard, which other blocks do not read where there is a loss.
__global__ void __launch_bounds__(kThreads)
    adam_kernel(AdamTensors tensors, AdamGuard guard, const float* __restrict__ corrected,
                const float* __restrict__ votes, int count, bool last) {
  const bool left_out = is_left_out(guard, votes, count);
  if (last && guard.loss != nullptr && blockIdx.x == 0 && threadIdx.x == 0) {
    const float found = left_out ? 1.0f : 0.0f;
    *guard.found = found;
    *guard.skipped += found;
    *guard.in_a_row = (*guard.in_a_row + 1.0f) * found;
  }
  if (left_out) return;
  int number = 0;
  while (number + 1 < tensors.count && blockIdx.x >= tensors.of[number + 1].first) ++number;
  const AdamTensor& tensor = tensors.of[number];
  const AdamStep rule{corrected[2 * number], static_cast<float>(tensor.rule.decay),
                      static_cast<float>(tensor.rule.decay_sq), corrected[2 * number + 1], tensor.rule.every};
  const float scale = guard.scale == nullptr ? 1.0f : *guard.scale;
  const unsigned block = blockIdx.x - tensor.first;
  for (int part = 0; part < kRun / kThreads; ++part) {
    const int64_t i = static_cast<int64_t>(block) * kRun + part * kThreads + threadIdx.x;
    if (i >= tensor.n) break;
    const float g = tensor.gradient[i];
    if (rule.every || g != 0.0f) update_entry(rule, g / scale, tensor.parameter, tensor.mean, tensor.square, i);
  }
  // What this step is was read in the launch before.
  if (block == 0 && threadIdx.x == 0) *tensor.rule.step += 1.0f;
}

}  // namespace

int64_t adam_workspace_cuda(int64_t count) { return kVotes + 2 * count; }

void adam_cuda(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
               float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
               float* workspace, void* stream) {
  const size_t count = rules.size();
  const auto each = [&](const auto& run) {
    for (size_t begin = 0; begin < count; begin += kMost) {
      const size_t end = std::min<size_t>(count, begin + kMost);
      AdamTensors tensors{};
      unsigned blocks = 0;
      for (size_t i = begin; i < end; ++i) {
        AdamTensor& tensor = tensors.of[tensors.count++];
        tensor = {gradients[i], parameters[i], means[i], squares[i], sizes[i], rules[i], blocks, tensors.judged};
        blocks += static_cast<unsigned>(ceil_div<int64_t>(std::max<int64_t>(sizes[i], 1), kRun));
        if (guard.loss != nullptr && rules[i].every) {
          tensors.judged += static_cast<unsigned>(ceil_div<int64_t>(sizes[i], kJudgedRun));
        }
      }
      run(tensors, blocks, workspace + kVotes + 2 * begin, begin == 0, end == count);
    }
  };
  unsigned judged = 0;  // the most of a launch: all of them have the same votes
  each([&](const AdamTensors& tensors, auto...) { judged = std::max(judged, tensors.judged); });
  const unsigned votes = 1 + std::min<unsigned>(judged, kVotes - 1);
  each([&](const AdamTensors& tensors, unsigned, float* corrected, bool first, bool) {
    VN_LAUNCH(adam_judge_kernel, votes, kJudgeThreads, 0, stream, tensors, guard, corrected, workspace, first);
  });
  each([&](const AdamTensors& tensors, unsigned blocks, float* corrected, bool, bool last) {
    VN_LAUNCH(adam_kernel, blocks, kThreads, 0, stream, tensors, guard, corrected, workspace, static_cast<int>(votes),
              last);
  });
}

}  // namespace voronerf
