// Activations of a tile of values, and their derivatives.
#pragma once

#include "common/elementwise_math.h"
#include "common/memory_tile.h"
#include "network/cpu/grouped_mlp_plan.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Activation as in grouped_mlp.h, which a file compiled per instruction set cannot include: it uses the standard
// library.
constexpr int kRelu = 1, kSoftplus = 2, kSigmoid = 3, kSine = 4;

// Few outputs, as heads have, and points are not worth a call of memcpy.
VN_INLINE void copy_row(const float* from, int64_t width, float* to) {
  if (width == 3) {
    __builtin_memcpy(to, from, 3 * sizeof(float));
    return;
  }
  if (width == 4) {
    __builtin_memcpy(to, from, 4 * sizeof(float));
    return;
  }
  int64_t c = 0;
  for (; c + kLanes <= width; c += kLanes) store(to + c, load(from + c));
  if (c < width && width >= kLanes) {
    store(to + width - kLanes, load(from + width - kLanes));
    return;
  }
  for (; c < width; ++c) to[c] = from[c];
}

// In place; sine leaves its cosine in `slope` where that is kept.
[[maybe_unused]] void activate(const MlpPlanLayer& layer, int64_t rows, float* value, float* slope) {
  const int64_t size = rows * layer.padded;
  for (int64_t i = 0; i < size; i += kLanes) {
    const F32 x = load(value + i);
    if (layer.activation == kSoftplus) {
      store(value + i, softplus(x));
    } else if (layer.activation == kSigmoid) {
      store(value + i, sigmoid(x));
    } else if (beyond_sine(x)) {
      for (int lane = 0; lane < kLanes; ++lane) {
        const float angle = value[i + lane];
        value[i + lane] = __builtin_sinf(angle);
        if (slope != nullptr) slope[i + lane] = __builtin_cosf(angle);
      }
    } else {
      store(value + i, sine(x, splat(0.0f)));
      if (slope != nullptr) store(slope + i, sine(x, splat(0.5f)));
    }
  }
}

// gradient *= the activation's derivative, from its output or, for sine, from the cosine that was kept.
[[maybe_unused]] void times_slope(const MlpPlanLayer& layer, int64_t rows, const float* value, const float* slope,
                                  float* gradient) {
  const int64_t size = rows * layer.padded;
  const F32 zero = splat(0.0f), one = splat(1.0f);
  for (int64_t i = 0; i < size; i += kLanes) {
    const F32 y = load(value + i), g = load(gradient + i);
    if (layer.activation == kRelu) {
      store(gradient + i, y <= zero ? zero : g);
      continue;
    }
    F32 factor = one;
    if (layer.activation == kSoftplus) factor = zero - exponential_minus_one(zero - y);
    if (layer.activation == kSigmoid) factor = y * (one - y);
    if (layer.activation == kSine) factor = load(slope + i);
    store(gradient + i, g * factor);
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
