// The encodings on CUDA. Octaves, forward: one thread per element of the result. Computing sine and cosine separately
// costs less than passing one of them through shared memory. Octaves, backward: one thread per feature of a point. A
// thread recomputes its sines and cosines, and neighbouring threads read the same cache lines of gradients. ByRow: one
// thread per row. Rows pass through shared memory, so that global accesses are coalesced; one padding column avoids
// bank conflicts.
#include <algorithm>

#include "common/cuda_wrappers.h"
#include "encoding/encode.h"
#include "encoding/encode_math.h"
#include "network/cuda/words_device.h"
// after words_device.h, which defines VN_WORDS
#include "encoding/encodings.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kRows = 64;             // rows of a block in the forward pass
constexpr int64_t kBlocks = 1 << 16;  // most blocks of a grid; a thread then takes several elements
constexpr int kFormulaThreads = 128;

__global__ void __launch_bounds__(kThreads)
    encode_kernel(const float* __restrict__ x, const float* __restrict__ variances, float* __restrict__ out, int64_t n,
                  int d, int octaves, int include_input) {
  const int width = d * (2 * octaves + include_input);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kRows;
  const int rows = n - first < kRows ? static_cast<int>(n - first) : kRows;
  // Elements have 32-bit indices within the block, because 32-bit division is cheap.
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
    if (grad_x != nullptr) grad_x[i] = of_x;
    if (grad_variances != nullptr) grad_variances[i] = of_variance;
  }
}

template <typename Formula>
__global__ void __launch_bounds__(kFormulaThreads)
    formula_kernel(const float* __restrict__ x, float* __restrict__ out, int64_t n, int d, int size, int width) {
  constexpr int kRow = Formula::kMost + 1;
  VN_SHARED(rows, float[kFormulaThreads * kRow]);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kFormulaThreads, row = first + threadIdx.x;
  const int count = n - first < kFormulaThreads ? static_cast<int>(n - first) : kFormulaThreads;
  if (row < n) {
    Formula::values([&](int i) { return x[d * row + i]; }, d, size,
                    [&](int c, float value) { rows[threadIdx.x * kRow + c] = value; });
  }
  __syncthreads();
  for (int i = threadIdx.x; i < count * width; i += kFormulaThreads) {
    out[first * width + i] = rows[i / width * kRow + i % width];
  }
}

template <typename Formula>
__global__ void __launch_bounds__(kFormulaThreads)
    formula_backward_kernel(const float* __restrict__ gradient, const float* __restrict__ x, float* __restrict__ grad_x,
                            int64_t n, int d, int size, int width) {
  constexpr int kRow = Formula::kMost + 1;
  VN_SHARED(rows, float[kFormulaThreads * kRow]);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kFormulaThreads, row = first + threadIdx.x;
  const int count = n - first < kFormulaThreads ? static_cast<int>(n - first) : kFormulaThreads;
  for (int i = threadIdx.x; i < count * width; i += kFormulaThreads) {
    rows[i / width * kRow + i % width] = gradient[first * width + i];
  }
  __syncthreads();
  if (row >= n) return;
  Formula::gradient([&](int i) { return x[d * row + i]; }, d, size, [&](int c) { return rows[threadIdx.x * kRow + c]; },
                    [&](int i, float value) { grad_x[d * row + i] = value; });
}

unsigned blocks_of(int64_t size, int threads) { return static_cast<unsigned>(ceil_div<int64_t>(size, threads)); }

// Octaves and ByRow launch the CUDA kernels for the two kinds of encodings in encodings.h.
template <bool kBlurred>
struct Octaves {
  static void values(const Encoding& in, float* out, void* stream) {
    VN_LAUNCH(encode_kernel, blocks_of(in.n, kRows), kThreads, 0, stream, in.x, in.variances, out, in.n, in.d, in.size,
              in.include_input ? 1 : 0);
  }
  static void gradient(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances, void* stream) {
    VN_LAUNCH(encode_backward_kernel, std::min<int64_t>(blocks_of(in.n * in.d, kThreads), kBlocks), kThreads, 0, stream,
              gradient, in.x, in.variances, grad_x, grad_variances, in.n, in.d, in.size, in.include_input ? 1 : 0);
  }
};
template <typename Formula>
struct ByRow {
  static void values(const Encoding& in, float* out, void* stream) {
    VN_LAUNCH(formula_kernel<Formula>, blocks_of(in.n, kFormulaThreads), kFormulaThreads, 0, stream, in.x, out, in.n,
              in.d, in.size, in.width);
  }
  static void gradient(const Encoding& in, const float* gradient, float* grad_x, float*, void* stream) {
    VN_LAUNCH(formula_backward_kernel<Formula>, blocks_of(in.n, kFormulaThreads), kFormulaThreads, 0, stream, gradient,
              in.x, grad_x, in.n, in.d, in.size, in.width);
  }
};

template <typename Run>
void with_kernel(const Encoding& in, const Run& run) {
  using namespace device;  // for the formulas
  switch (in.encoding) {
#define VN_CASE(NAME, ...)    \
  case ProgramEncoding::NAME: \
    return run(__VA_ARGS__());
    VN_ENCODINGS(VN_CASE)
#undef VN_CASE
    case ProgramEncoding::hash:
      return;
  }
}

}  // namespace

void encode_cuda(const Encoding& in, float* out, void* stream) {
  if (in.n * in.width == 0) return;
  with_kernel(in, [&](auto kernel) { kernel.values(in, out, stream); });
}

void encode_backward_cuda(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          void* stream) {
  if (in.n * in.d == 0) return;
  with_kernel(in, [&](auto kernel) { kernel.gradient(in, gradient, grad_x, grad_variances, stream); });
}

}  // namespace voronerf
