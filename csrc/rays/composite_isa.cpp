// The CPU kernels of composite, compiled once per instruction set.
//
// Let o_i = sigma_i delta_i be the optical depth of sample i, and F_i = o_0 + ... + o_(i-1) the optical depth in front
// of it. Its weight is exp(-F_i) (1 - exp(-o_i)). A ray is processed in chunks that stay in the L1 cache. Only the
// running sum is serial; it is float64 for precision. Exponentials and later operations run on vectors of samples; so
// do colours if there are three channels. Summing exponents, instead of multiplying transmittances, avoids the slow
// denormal numbers of such a product behind a surface, and gives 0 behind an infinite density.
//
// In the backward pass let G_i be the gradient with respect to weight i, through all outputs. Then
//     gradient of o_i = G_i exp(-F_i - o_i) - sum over j > i of G_j w_j.
// A first sweep along the ray stores F_i in the memory of sigma's gradient. A second sweep runs back and sums over the
// samples behind, beginning with the background. Nothing is saved in the forward pass. The background's weight is
// exp(-F) over the whole ray, which is more precise than 1 - opacity.
#include "rays/composite_isa.h"

#include "common/elementwise_math.h"
#include "common/memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kChunk = 128;
constexpr float kOpaque = 1e30f;  // replaces infinite density; just as opaque over any length but 0

// Caps a density at kOpaque; NaN stays NaN.
VN_INLINE float finite_density(float sigma) { return sigma > kOpaque ? kOpaque : sigma; }

// For a vector of samples: transmittance in front, transmittance of the samples themselves, and 1 minus the latter.
struct Passage {
  F32 front, through, absorbed;
};

// Computes the Passage of a vector of samples. Transmittances too small for float32 are 0.
VN_INLINE Passage passage(F32 front, F32 optical) {
  const F32 zero = splat(0.0f), far = splat(-87.0f);
  const F32 x = zero - front, y = zero - optical;
  const Exponential e = exponential_parts(y);
  return {x < far ? zero : exponential(x), y < far ? zero : fma(e.scale, e.p, e.scale),
          fma(zero - e.scale, e.p, splat(1.0f) - e.scale)};
}

// Returns the transmittance of a whole ray: 1 - opacity, without cancellation.
VN_INLINE float left_over(double optical) {
  float lanes[kLanes];
  store(lanes, passage(splat(static_cast<float>(optical)), splat(0.0f)).front);
  return lanes[0];
}

VN_INLINE const float* background_of(const CompositeInputs& in, int64_t ray) {
  return in.background == nullptr || !in.background_per_ray ? in.background : in.background + ray * in.c;
}

// Loads the first `count` lanes, zeros after them.
VN_INLINE F32 load_first(const float* from, int64_t count) {
  if (count >= kLanes) return load(from);
  float padded[kLanes] = {};
  __builtin_memcpy(padded, from, sizeof(float) * count);
  return load(padded);
}

VN_INLINE void store_first(float* to, F32 a, int64_t count) {
  if (count >= kLanes) {
    store(to, a);
  } else {
    __builtin_memcpy(to, &a, sizeof(float) * count);
  }
}

// Loads three channels of `count` samples.
VN_INLINE void load_colours(const float* from, int64_t count, F32& x, F32& y, F32& z) {
  if (count >= kLanes) {
    load_points(from, x, y, z);
  } else {
    float padded[3 * kLanes] = {};
    __builtin_memcpy(padded, from, 3 * sizeof(float) * count);
    load_points(padded, x, y, z);
  }
}

VN_INLINE float sum(F32 a) {
  float lanes[kLanes];
  store(lanes, a);
  for (int half = kLanes / 2; half > 0; half /= 2) {
    for (int i = 0; i < half; ++i) lanes[i] += lanes[i + half];
  }
  return lanes[0];
}

template <bool Rgb>
VN_INLINE void forward(const CompositeInputs& in, const CompositeOutputs& out, int64_t ray, int64_t begin,
                       int64_t end) {
  alignas(64) float optical[kChunk], front[kChunk];
  float* colour = out.colour + ray * in.c;
  for (int64_t k = 0; k < in.c; ++k) colour[k] = 0.0f;
  F32 opacity = splat(0.0f), depth = opacity, red = opacity, green = opacity, blue = opacity;
  double before = 0.0;
  for (int64_t first = begin; first < end; first += kChunk) {
    const int64_t count = end - first < kChunk ? end - first : kChunk;
    for (int64_t i = 0; i < count; ++i) optical[i] = finite_density(in.sigma[first + i]) * in.deltas[first + i];
    for (int64_t i = 0; i < count; ++i) {
      front[i] = static_cast<float>(before);
      before += static_cast<double>(optical[i]);
    }
    // Samples with density and weight 0 pad the last vector.
    for (int64_t i = count; i % kLanes != 0; ++i) optical[i] = front[i] = 0.0f;
    float* weights = out.weights + first;
    for (int64_t i = 0; i < count; i += kLanes) {
      const Passage light = passage(load(front + i), load(optical + i));
      const F32 weight = light.front * light.absorbed;
      store_first(weights + i, weight, count - i);
      opacity = add(opacity, weight);
      depth = fma(weight, load_first(in.depths + first + i, count - i), depth);
      if (Rgb) {
        F32 x, y, z;
        load_colours(in.rgb + 3 * (first + i), count - i, x, y, z);
        red = fma(weight, x, red);
        green = fma(weight, y, green);
        blue = fma(weight, z, blue);
      }
    }
    for (int64_t k = 0; !Rgb && k < in.c; ++k) {
      const float* rgb = in.rgb + first * in.c + k;
      float part = 0.0f;
      for (int64_t i = 0; i < count; ++i) part += weights[i] * rgb[i * in.c];
      colour[k] += part;
    }
  }
  if (Rgb) {
    colour[0] = sum(red);
    colour[1] = sum(green);
    colour[2] = sum(blue);
  }
  out.opacity[ray] = sum(opacity);
  out.depth[ray] = sum(depth);
  const float* background = background_of(in, ray);
  const float left = background == nullptr ? 0.0f : left_over(before);
  for (int64_t k = 0; background != nullptr && k < in.c; ++k) colour[k] += left * background[k];
}

// Computes the gradients of the weights of samples [first, first + count), from the gradients of the outputs: `colour`
// [c] or null, `opacity`, `depth`.
template <bool Rgb>
VN_INLINE void weights_backward(const CompositeInputs& in, const CompositeGradients& gradients, int64_t first,
                                int64_t count, const float* colour, float opacity, float depth, float* result) {
  for (int64_t i = 0; i < count; i += kLanes) {
    F32 gradient = splat(opacity);
    if (gradients.weights != nullptr) gradient = add(gradient, load_first(gradients.weights + first + i, count - i));
    if (gradients.depth != nullptr) {
      gradient = fma(splat(depth), load_first(in.depths + first + i, count - i), gradient);
    }
    if (Rgb && colour != nullptr) {
      F32 x, y, z;
      load_colours(in.rgb + 3 * (first + i), count - i, x, y, z);
      gradient = fma(splat(colour[0]), x, fma(splat(colour[1]), y, fma(splat(colour[2]), z, gradient)));
    }
    store(result + i, gradient);
  }
  for (int64_t i = 0; !Rgb && colour != nullptr && i < count; ++i) {
    float part = 0.0f;
    for (int64_t k = 0; k < in.c; ++k) part += colour[k] * in.rgb[(first + i) * in.c + k];
    result[i] += part;
  }
}

template <bool Rgb>
VN_INLINE void rgb_backward(const float* weights, const float* colour, int64_t c, int64_t count, float* result) {
  if (colour == nullptr) {
    for (int64_t i = 0; i < count * c; ++i) result[i] = 0.0f;
  } else if (Rgb) {
    const float red = colour[0], green = colour[1], blue = colour[2];
    for (int64_t i = 0; i < count; ++i) {
      result[3 * i] = weights[i] * red;
      result[3 * i + 1] = weights[i] * green;
      result[3 * i + 2] = weights[i] * blue;
    }
  } else {
    for (int64_t i = 0; i < count; ++i) {
      for (int64_t k = 0; k < c; ++k) result[i * c + k] = weights[i] * colour[k];
    }
  }
}

template <bool Rgb>
VN_INLINE void backward(const CompositeInputs& in, const CompositeGradients& gradients, int64_t ray, int64_t begin,
                        int64_t end) {
  alignas(64) float optical[kChunk], front[kChunk], weights[kChunk], terms[kChunk], share[kChunk];
  const float* colour = gradients.colour == nullptr ? nullptr : gradients.colour + ray * in.c;
  const float depth = gradients.depth == nullptr ? 0.0f : gradients.depth[ray];
  const float opacity = gradients.opacity == nullptr ? 0.0f : gradients.opacity[ray];
  double before = 0.0;
  for (int64_t i = begin; i < end; ++i) {
    gradients.sigma[i] = static_cast<float>(before);
    before += static_cast<double>(finite_density(in.sigma[i]) * in.deltas[i]);
  }
  double behind = 0.0;
  const float* background = background_of(in, ray);
  if (background != nullptr) {
    const float left = gradients.left[ray] = left_over(before);
    for (int64_t k = 0; colour != nullptr && k < in.c; ++k) {
      behind += static_cast<double>(colour[k]) * background[k] * left;
    }
  }
  for (int64_t last = end; last > begin;) {
    const int64_t count = (last - begin - 1) % kChunk + 1, first = last - count;
    const float *sigma = in.sigma + first, *deltas = in.deltas + first;
    for (int64_t i = 0; i < count; ++i) optical[i] = finite_density(sigma[i]) * deltas[i];
    __builtin_memcpy(front, gradients.sigma + first, sizeof(float) * count);
    for (int64_t i = count; i % kLanes != 0; ++i) optical[i] = front[i] = 0.0f;
    weights_backward<Rgb>(in, gradients, first, count, colour, opacity, depth, terms);
    for (int64_t i = 0; i < count; i += kLanes) {
      const Passage light = passage(load(front + i), load(optical + i));
      const F32 weight = light.front * light.absorbed, gradient = load(terms + i);
      store(weights + i, weight);
      store(share + i, gradient * weight);
      store(terms + i, gradient * (light.front * light.through));
    }
    for (int64_t i = count; i-- > 0;) {
      terms[i] = static_cast<float>(static_cast<double>(terms[i]) - behind);
      behind += static_cast<double>(share[i]);
    }
    for (int64_t i = 0; i < count; ++i) {
      gradients.sigma[first + i] = sigma[i] <= kOpaque ? terms[i] * deltas[i] : 0.0f;
    }
    for (int64_t i = 0; gradients.deltas != nullptr && i < count; ++i) {
      gradients.deltas[first + i] = terms[i] * finite_density(sigma[i]);
    }
    for (int64_t i = 0; gradients.depths != nullptr && i < count; ++i) {
      gradients.depths[first + i] = depth * weights[i];
    }
    if (gradients.rgb != nullptr) rgb_backward<Rgb>(weights, colour, in.c, count, gradients.rgb + first * in.c);
    last = first;
  }
}

}  // namespace

void composite_ray(const CompositeInputs& in, const CompositeOutputs& out, int64_t ray, int64_t begin, int64_t end) {
  if (in.c == 3) {
    forward<true>(in, out, ray, begin, end);
  } else {
    forward<false>(in, out, ray, begin, end);
  }
}

void composite_ray_backward(const CompositeInputs& in, const CompositeGradients& gradients, int64_t ray, int64_t begin,
                            int64_t end) {
  if (in.c == 3) {
    backward<true>(in, gradients, ray, begin, end);
  } else {
    backward<false>(in, gradients, ray, begin, end);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
