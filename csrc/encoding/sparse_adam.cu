// Adam on the entries that have a gradient on CUDA, a thread an entry. Neighbouring threads have neighbouring entries:
// a warp reads its whole line of gradients, and of the other three arrays only the sectors that have one.
#include "common/cuda_wrappers.h"
#include "encoding/sparse_adam.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    sparse_adam_kernel(SparseAdam rule, const float* __restrict__ gradient, float* __restrict__ parameter,
                       float* __restrict__ mean, float* __restrict__ square, int64_t n) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  const float g = gradient[i];
  if (g == 0.0f) return;
  const float m = rule.decay * mean[i] + (1.0f - rule.decay) * g;
  const float v = rule.decay_sq * square[i] + (1.0f - rule.decay_sq) * (g * g);
  mean[i] = m;
  square[i] = v;
  parameter[i] -= rule.step_size * (m / (sqrtf(v) + rule.epsilon));
}

}  // namespace

void sparse_adam_cuda(const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square,
                      int64_t n, void* stream) {
  if (n == 0) return;
  VN_LAUNCH(sparse_adam_kernel, static_cast<unsigned>(ceil_div<int64_t>(n, kThreads)), kThreads, 0, stream, rule,
            gradient, parameter, mean, square, n);
}

}  // namespace voronerf
