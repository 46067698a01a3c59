// The encodings on CUDA. Forward, a thread an element of the result: each is written once, side by side, and computing
// sine and cosine apart costs less than passing one of them through shared memory. Backward, a thread a feature of a
// point; it computes its sines and cosines again, and its gradients, a row of 4 (1 + 2 L) d bytes apart, share their
// cache lines with the neighbouring threads'.
#include "common/cuda_wrappers.h"
#include "encoding/encode.h"
#include "encoding/encode_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kRows = 64;             // of a block, forward
constexpr int64_t kBlocks = 1 << 16;  // of a grid, whose threads then take several elements

__global__ void __launch_bounds__(kThreads)
    encode_kernel(const float* __restrict__ x, const float* __restrict__ variances, float* __restrict__ out, int64_t n,
                  int d, int octaves, int include_input) {
  const int width = d * (2 * octaves + include_input);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kRows;
  const int rows = n - first < kRows ? static_cast<int>(n - first) : kRows;
  // Rows of a block are numbered in 32 bits, in which division is cheap.
  for (int j = threadIdx.x; j < rows * width; j += kThreads) {
    const int64_t row = first + j / width, i = first * width + j;
    int column = j % width;
    if (include_input != 0 && column < d) {
      out[i] = x[row * d + column];
      continue;
    }
    column -= include_input * d;
    const int part = column / d, feature = column - part * d;
    const float scale = octave_scale(part / 2), angle = x[row * d + feature] * scale;
    const float value = sine_of_octave(angle, part % 2 == 0 ? 0.0f : 0.5f);
    out[i] = variances == nullptr ? value : value * octave_blur(scale, variances[row * d + feature]);
  }
}

__global__ void __launch_bounds__(kThreads)
    encode_backward_kernel(const float* __restrict__ gradient, const float* __restrict__ x,
                           const float* __restrict__ variances, float* __restrict__ grad_x,
                           float* __restrict__ grad_variances, int64_t n, int d, int octaves, int include_input) {
  const int width = d * (2 * octaves + include_input);
  const int64_t size = n * d, step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < size; i += step) {
    const int64_t row = i / d;
    const int feature = static_cast<int>(i - row * d);
    const float* g = gradient + row * width + feature;
    float of_x = include_input != 0 ? *g : 0.0f, of_variance = 0.0f;
    g += include_input * d;
    for (int octave = 0; octave < octaves; ++octave, g += 2 * d) {
      const float scale = octave_scale(octave), angle = x[i] * scale;
      const float sine = sine_of_octave(angle, 0.0f), cosine = sine_of_octave(angle, 0.5f);
      const float blur = variances == nullptr ? 1.0f : octave_blur(scale, variances[i]);
      of_x += scale * blur * (g[0] * cosine - g[d] * sine);
      if (variances != nullptr) of_variance += -0.5f * scale * scale * blur * (g[0] * sine + g[d] * cosine);
    }
    grad_x[i] = of_x;
    if (variances != nullptr) grad_variances[i] = of_variance;
  }
}

unsigned blocks_of(int64_t size) {
  const int64_t blocks = ceil_div<int64_t>(size, kThreads);
  return static_cast<unsigned>(blocks < kBlocks ? blocks : kBlocks);
}

}  // namespace

void encode_cuda(const Encoding& in, float* out, void* stream) {
  if (in.n * in.width == 0) return;
  VN_LAUNCH(encode_kernel, static_cast<unsigned>(ceil_div<int64_t>(in.n, kRows)), kThreads, 0, stream, in.x,
            in.variances, out, in.n, static_cast<int>(in.d), static_cast<int>(in.octaves), in.include_input ? 1 : 0);
}

void encode_backward_cuda(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          void* stream) {
  if (in.n * in.d == 0) return;
  VN_LAUNCH(encode_backward_kernel, blocks_of(in.n * in.d), kThreads, 0, stream, gradient, in.x, in.variances, grad_x,
            grad_variances, in.n, static_cast<int>(in.d), static_cast<int>(in.octaves), in.include_input ? 1 : 0);
}

}  // namespace voronerf
