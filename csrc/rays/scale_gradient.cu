// The gradients of samples near the camera on CUDA, a thread a sample.
#include "common/cuda_wrappers.h"
#include "rays/scale_gradient.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads) scale_gradient_kernel(const float* __restrict__ depths, float full,
                                                                  int64_t m, int64_t c, float* __restrict__ gradient) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= m) return;
  const float share = gradient_share(depths[i], full);
  for (int64_t j = 0; j < c; ++j) gradient[i * c + j] *= share;
}

}  // namespace

void scale_gradient_cuda(const float* depths, float full, int64_t m, int64_t c, float* gradient, void* stream) {
  if (m == 0) return;
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(m, kThreads));
  VN_LAUNCH(scale_gradient_kernel, blocks, kThreads, 0, stream, depths, full, m, c, gradient);
}

}  // namespace voronerf
