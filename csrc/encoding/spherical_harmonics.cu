// Spherical harmonics on CUDA, a thread a direction. Rows of up to 16 values pass through shared memory, so that
// neighbouring threads read and write neighbouring numbers there; a column more than a row has keeps them off each
// other's banks.
#include "common/cuda_wrappers.h"
#include "encoding/spherical_harmonics.h"
#include "network/cuda/words_device.h"
// behind the words
#include "encoding/spherical_harmonics_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;
constexpr int kRow = device::SphericalHarmonics::kMost + 1;

__global__ void __launch_bounds__(kThreads)
    harmonics_kernel(const float* __restrict__ directions, float* __restrict__ out, int64_t n, int degree) {
  VN_SHARED(rows, float[kThreads * kRow]);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kThreads, row = first + threadIdx.x;
  const int count = n - first < kThreads ? static_cast<int>(n - first) : kThreads, width = degree * degree;
  if (row < n) {
    device::SphericalHarmonics::values([&](int axis) { return directions[3 * row + axis]; }, 3, degree,
                                       [&](int c, float value) { rows[threadIdx.x * kRow + c] = value; });
  }
  __syncthreads();
  for (int i = threadIdx.x; i < count * width; i += kThreads) {
    out[first * width + i] = rows[i / width * kRow + i % width];
  }
}

__global__ void __launch_bounds__(kThreads)
    harmonics_backward_kernel(const float* __restrict__ directions, const float* __restrict__ gradient,
                              float* __restrict__ grad_directions, int64_t n, int degree) {
  VN_SHARED(rows, float[kThreads * kRow]);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kThreads, row = first + threadIdx.x;
  const int count = n - first < kThreads ? static_cast<int>(n - first) : kThreads, width = degree * degree;
  for (int i = threadIdx.x; i < count * width; i += kThreads) {
    rows[i / width * kRow + i % width] = gradient[first * width + i];
  }
  __syncthreads();
  if (row >= n) return;
  device::SphericalHarmonics::gradient([&](int axis) { return directions[3 * row + axis]; }, 3, degree,
                                       [&](int c) { return rows[threadIdx.x * kRow + c]; },
                                       [&](int axis, float found) { grad_directions[3 * row + axis] = found; });
}

unsigned blocks_of(int64_t n) { return static_cast<unsigned>(ceil_div<int64_t>(n, kThreads)); }

}  // namespace

void spherical_harmonics_cuda(const float* directions, float* out, int64_t n, int64_t degree, void* stream) {
  if (n == 0) return;
  VN_LAUNCH(harmonics_kernel, blocks_of(n), kThreads, 0, stream, directions, out, n, static_cast<int>(degree));
}

void spherical_harmonics_backward_cuda(const float* directions, const float* gradient, float* grad_directions,
                                       int64_t n, int64_t degree, void* stream) {
  if (n == 0) return;
  VN_LAUNCH(harmonics_backward_kernel, blocks_of(n), kThreads, 0, stream, directions, gradient, grad_directions, n,
            static_cast<int>(degree));
}

}  // namespace voronerf
