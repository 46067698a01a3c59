// Adam on CUDA, a thread an entry. Neighbouring threads have neighbouring entries: a warp reads its whole line of
// gradients, and of the other three arrays only the sectors that have one.
//
// A step of a training is two launches for all parameters, and reads nothing on the host: one block looks at the
// gradients of the networks, which are few beside those of the tables, decides whether the step is left out, and
// corrects the rates; then every block updates a run of one parameter.
#include <algorithm>

#include "common/cuda_wrappers.h"
#include "encoding/adam.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kPrepareThreads = 1024;
constexpr int kRun = 4 * kThreads;  // entries of a block
constexpr int kMost = 36;           // parameters of a launch: their pointers are its arguments, of which 4 KB fit

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
  unsigned first;  // block
};
struct AdamTensors {
  AdamTensor of[kMost];
  int count;
};
static_assert(sizeof(AdamTensors) <= 3900, "arguments of a launch");

// One block. `first` and `last` of the launches for all parameters.
__global__ void __launch_bounds__(kPrepareThreads)
    adam_prepare_kernel(AdamTensors tensors, AdamGuard guard, float* corrected, bool first, bool last) {
  VN_SHARED(votes, unsigned[kPrepareThreads / 32]);
  if (static_cast<int>(threadIdx.x) < tensors.count) {
    const AdamRule& rule = tensors.of[threadIdx.x].rule;
    const double step = static_cast<double>(*rule.step) + 1.0, root = sqrt(1.0 - pow(rule.decay_sq, step));
    const double rate = rule.rate_at == nullptr ? rule.rate : *rule.rate_at;
    corrected[2 * threadIdx.x] = static_cast<float>(rate * root / (1.0 - pow(rule.decay, step)));
    corrected[2 * threadIdx.x + 1] = static_cast<float>(rule.epsilon * root);
  }
  if (guard.loss == nullptr) return;
  bool large = threadIdx.x == 0 && !(fabsf(*guard.loss) < guard.limit);
  for (int number = 0; number < tensors.count; ++number) {
    const AdamTensor& tensor = tensors.of[number];
    if (!tensor.rule.every) continue;
    for (int64_t i = threadIdx.x; i < tensor.n; i += kPrepareThreads) {
      large |= !(fabsf(tensor.gradient[i]) < guard.limit);
    }
  }
  const unsigned of_warp = __ballot_sync(kAllLanes, large);
  if (threadIdx.x % 32 == 0) votes[threadIdx.x / 32] = of_warp;
  __syncthreads();
  if (threadIdx.x != 0) return;
  float found = first ? 0.0f : *guard.found;
  for (unsigned vote : votes) found = vote != 0 ? 1.0f : found;
  *guard.found = found;
  if (!last) return;
  *guard.skipped += found;
  *guard.in_a_row = (*guard.in_a_row + 1.0f) * found;
}

__global__ void __launch_bounds__(kThreads)
    adam_kernel(AdamTensors tensors, AdamGuard guard, const float* __restrict__ corrected) {
  if (guard.found != nullptr && *guard.found != 0.0f) return;
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

void adam_cuda(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
               float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
               float* corrected, void* stream) {
  const size_t count = rules.size();
  const auto each = [&](const auto& run) {
    for (size_t begin = 0; begin < count; begin += kMost) {
      const size_t end = std::min<size_t>(count, begin + kMost);
      AdamTensors tensors{};
      unsigned blocks = 0;
      for (size_t i = begin; i < end; ++i) {
        tensors.of[tensors.count++] = {gradients[i], parameters[i], means[i], squares[i], sizes[i], rules[i], blocks};
        blocks += static_cast<unsigned>(ceil_div<int64_t>(std::max<int64_t>(sizes[i], 1), kRun));
      }
      run(tensors, blocks, corrected + 2 * begin, begin == 0, end == count);
    }
  };
  each([&](const AdamTensors& tensors, unsigned, float* own, bool first, bool last) {
    VN_LAUNCH(adam_prepare_kernel, 1, kPrepareThreads, 0, stream, tensors, guard, own, first, last);
  });
  each([&](const AdamTensors& tensors, unsigned blocks, float* own, bool, bool) {
    VN_LAUNCH(adam_kernel, blocks, kThreads, 0, stream, tensors, guard, own);
  });
}

}  // namespace voronerf
