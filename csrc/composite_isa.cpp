// The CPU kernels of composite, once for each instruction set. Optical depths are summed one after the other, in
// float64, as their order is the point; exponentials, which cost most, run in lanes over a chunk of the ray's samples.
#include "composite_isa.h"

#include "elementwise_math.h"
#include "memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kChunk = 64;
constexpr float kOpaque = 1e30f;  // stands for infinite density: as opaque over any length but 0

// A NaN stays one.
VN_INLINE float finite_density(float sigma) {
  return sigma > kOpaque ? kOpaque : sigma;
}

// exp(-x), 0 where float32 has nothing smaller.
VN_INLINE F32 passed(F32 x) {
  const F32 zero = splat(0.0f);
  return x > splat(87.0f) ? zero : exponential(zero - x);
}

// What a whole ray lets through: 1 - opacity, without the digits that the subtraction would cost.
VN_INLINE float left_over(double optical) {
  float lanes[kLanes];
  store(lanes, passed(splat(static_cast<float>(optical))));
  return lanes[0];
}

VN_INLINE const float* background_of(const CompositeInputs& in, int64_t ray) {
  return in.background == nullptr || !in.background_per_ray ? in.background : in.background + ray * in.c;
}

}  // namespace

void composite_ray(const CompositeInputs& in, const CompositeOutputs& out, int64_t ray, int64_t begin, int64_t end) {
  double before = 0.0;
  float opacity = 0.0f, depth = 0.0f;
  float* colour = out.colour + ray * in.c;
  for (int64_t k = 0; k < in.c; ++k) colour[k] = 0.0f;
  for (int64_t first = begin; first < end; first += kChunk) {
    const int64_t count = end - first < kChunk ? end - first : kChunk;
    float optical[kChunk] = {}, in_front[kChunk] = {}, weights[kChunk];
    for (int64_t i = 0; i < count; ++i) {
      optical[i] = finite_density(in.sigma[first + i]) * in.deltas[first + i];
      in_front[i] = static_cast<float>(before);
      before += static_cast<double>(optical[i]);
    }
    for (int64_t i = 0; i < count; i += kLanes) {
      const F32 zero = splat(0.0f);
      store(weights + i, passed(load(in_front + i)) * (zero - exponential_minus_one(zero - load(optical + i))));
    }
    for (int64_t i = 0; i < count; ++i) {
      const float weight = weights[i];
      out.weights[first + i] = weight;
      opacity += weight;
      depth += weight * in.depths[first + i];
      const float* rgb = in.rgb + (first + i) * in.c;
      for (int64_t k = 0; k < in.c; ++k) colour[k] += weight * rgb[k];
    }
  }
  const float* background = background_of(in, ray);
  const float light = left_over(before);
  for (int64_t k = 0; background != nullptr && k < in.c; ++k) colour[k] += light * background[k];
  out.opacity[ray] = opacity;
  out.depth[ray] = depth;
}

// With G the gradient of a sample's weight w = T (1 - e^-o), that of its optical depth o is T e^-o G less the sum of w
// G over the samples behind, so samples are walked from the last to the first. What is in front of and in each is
// summed first, and kept where the gradient of sigma goes.
void composite_ray_backward(const CompositeInputs& in, const CompositeOutputs& out, const CompositeGradients& gradients,
                            int64_t ray, int64_t begin, int64_t end) {
  double through = 0.0;
  for (int64_t i = begin; i < end; ++i) {
    through += static_cast<double>(finite_density(in.sigma[i]) * in.deltas[i]);
    gradients.sigma[i] = static_cast<float>(through);
  }
  const float* background = background_of(in, ray);
  const float* colour = gradients.colour + ray * in.c;
  const float depth = gradients.depth[ray];
  double opacity = gradients.opacity[ray];
  for (int64_t k = 0; background != nullptr && k < in.c; ++k) opacity -= static_cast<double>(colour[k]) * background[k];
  if (gradients.background != nullptr) {
    const float light = left_over(through);
    for (int64_t k = 0; k < in.c; ++k) gradients.background[ray * in.c + k] = light * colour[k];
  }
  double behind = 0.0;
  for (int64_t last = end; last > begin; last -= kChunk) {
    const int64_t count = last - begin < kChunk ? last - begin : kChunk, first = last - count;
    float left[kChunk] = {};
    __builtin_memcpy(left, gradients.sigma + first, sizeof(float) * count);
    for (int64_t i = 0; i < count; i += kLanes) store(left + i, passed(load(left + i)));
    for (int64_t i = count; i-- > 0;) {
      const int64_t at = first + i;
      const float* rgb = in.rgb + at * in.c;
      const float weight = out.weights[at];
      double of_weight =
          static_cast<double>(gradients.weights[at]) + opacity + static_cast<double>(depth) * in.depths[at];
      for (int64_t k = 0; k < in.c; ++k) {
        of_weight += static_cast<double>(colour[k]) * rgb[k];
        gradients.rgb[at * in.c + k] = weight * colour[k];
      }
      const float of_optical = static_cast<float>(left[i] * of_weight - behind);
      behind += weight * of_weight;
      gradients.depths[at] = weight * depth;
      gradients.sigma[at] = in.sigma[at] <= kOpaque ? of_optical * in.deltas[at] : 0.0f;
      gradients.deltas[at] = of_optical * finite_density(in.sigma[at]);
    }
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
