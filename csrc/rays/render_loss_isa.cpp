// The CPU kernels of render_loss, once for each instruction set.
//
// The arithmetic is that of composite (composite_isa.cpp) between the activations of the networks' outputs and the
// squared error of the colour. A ray goes by twice: forwards in chunks that stay in the first-level cache, until its
// colour and so the gradient to it is known, and backwards with the sum of what is behind. A ray of one chunk, almost
// every ray, is activated once. Longer rays are activated again on the way back; the optical depth in front of their
// samples waits where the gradient of the density is to be.
#include "rays/render_loss_isa.h"

#include "common/elementwise_math.h"
#include "common/memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kChunk = 128;
constexpr float kOpaque = 1e30f;  // stands for infinite density: as opaque over any length but 0

// Samples [first, first + count), in the order of a ray, filled up to whole vectors by samples of no extent.
struct Chunk {
  alignas(64) float rgb[3][kChunk];
  alignas(64) float density[kChunk], slope[kChunk];  // slope: of the density to its raw output
  alignas(64) float deltas[kChunk], optical[kChunk], front[kChunk];
};

VN_INLINE F32 finite(F32 density) {
  return density > splat(kOpaque) ? splat(kOpaque) : density;  // a NaN stays one
}

VN_INLINE void activate(const RenderLossInputs& in, int64_t first, int64_t count, Chunk& chunk) {
  const float* raw = in.raw + 4 * first;
  for (int64_t i = 0; i < count; ++i) {
    for (int k = 0; k < 3; ++k) chunk.rgb[k][i] = raw[4 * i + k];
    chunk.density[i] = raw[4 * i + 3];
    chunk.deltas[i] = in.deltas[first + i];
  }
  for (int64_t i = count; i % kLanes != 0; ++i) {
    for (int k = 0; k < 3; ++k) chunk.rgb[k][i] = 0.0f;
    chunk.density[i] = chunk.deltas[i] = 0.0f;
  }
  const F32 scale = splat(in.density_scale);
  for (int64_t i = 0; i < count; i += kLanes) {
    for (int k = 0; k < 3; ++k) store(chunk.rgb[k] + i, sigmoid(load(chunk.rgb[k] + i)));
    const F32 x = load(chunk.density + i), density = softplus(x) * scale;
    store(chunk.density + i, density);
    store(chunk.slope + i, density > splat(kOpaque) ? splat(0.0f) : sigmoid(x) * scale);
    store(chunk.optical + i, finite(density) * load(chunk.deltas + i));
  }
}

VN_INLINE void put(float* to, const float* from, int64_t count) {
  __builtin_memcpy(to, from, sizeof(float) * count);
}

// exp(-x) for x >= 0, 0 where float32 has nothing smaller.
VN_INLINE F32 transmittance(F32 x) {
  const F32 minus = splat(0.0f) - x;
  return minus < splat(-87.0f) ? splat(0.0f) : exponential(minus);
}

VN_INLINE float sum(F32 a) {
  float lanes[kLanes];
  store(lanes, a);
  for (int half = kLanes / 2; half > 0; half /= 2) {
    for (int i = 0; i < half; ++i) lanes[i] += lanes[i + half];
  }
  return lanes[0];
}

VN_INLINE void render_ray(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t ray, int64_t begin,
                          int64_t end, Chunk& chunk) {
  F32 light[3] = {splat(0.0f), splat(0.0f), splat(0.0f)};
  double before = 0.0;
  const bool together = end - begin <= kChunk;
  for (int64_t first = begin; first < end; first += kChunk) {
    const int64_t count = end - first < kChunk ? end - first : kChunk;
    activate(in, first, count, chunk);
    put(out.density + first, chunk.density, count);
    for (int64_t i = 0; i < count; ++i) {
      chunk.front[i] = static_cast<float>(before);
      before += static_cast<double>(chunk.optical[i]);
    }
    for (int64_t i = count; i % kLanes != 0; ++i) chunk.front[i] = 0.0f;
    for (int64_t i = 0; i < count; i += kLanes) {
      const F32 weight = transmittance(load(chunk.front + i)) *
                         (splat(0.0f) - exponential_minus_one(splat(0.0f) - load(chunk.optical + i)));
      for (int k = 0; k < 3; ++k) light[k] = fma(weight, load(chunk.rgb[k] + i), light[k]);
    }
    for (int64_t i = 0; !together && i < count; ++i) out.gradient[4 * (first + i) + 3] = chunk.front[i];
  }
  const float* background = in.background;
  if (background != nullptr && in.background_per_ray) background += 3 * ray;
  float lanes[kLanes];
  store(lanes, transmittance(splat(static_cast<float>(before))));
  const float left = lanes[0], share = 2.0f / (3.0f * static_cast<float>(in.r));
  float slopes[3], error = 0.0f;
  double behind = 0.0;
  for (int k = 0; k < 3; ++k) {
    const float shown = background == nullptr ? 0.0f : background[k];
    const float colour = sum(light[k]) + left * shown, off = colour - in.target[3 * ray + k];
    out.colour[3 * ray + k] = colour;
    error += off * off;
    slopes[k] = off * share;
    behind += static_cast<double>(slopes[k]) * shown * left;
  }
  out.error[ray] = error;
  for (int64_t last = end; last > begin;) {
    const int64_t count = (last - begin - 1) % kChunk + 1, first = last - count;
    if (!together) {
      activate(in, first, count, chunk);
      for (int64_t i = 0; i < count; ++i) chunk.front[i] = out.gradient[4 * (first + i) + 3];
      for (int64_t i = count; i % kLanes != 0; ++i) chunk.front[i] = 0.0f;
    }
    alignas(64) float weights[kChunk], part[kChunk], own[kChunk];
    for (int64_t i = 0; i < count; i += kLanes) {
      const F32 minus = splat(0.0f) - load(chunk.optical + i), front = transmittance(load(chunk.front + i));
      const F32 absorbed = splat(0.0f) - exponential_minus_one(minus);
      const F32 through = transmittance(load(chunk.optical + i)), weight = front * absorbed;
      F32 gradient = splat(0.0f);
      for (int k = 0; k < 3; ++k) {
        const F32 value = load(chunk.rgb[k] + i);
        gradient = fma(splat(slopes[k]), value, gradient);
        store(chunk.rgb[k] + i, weight * splat(slopes[k]) * (value * (splat(1.0f) - value)));
      }
      store(weights + i, weight);
      store(part + i, gradient * weight);
      store(own + i, gradient * (front * through));
    }
    for (int64_t i = count; i-- > 0;) {
      own[i] = static_cast<float>(static_cast<double>(own[i]) - behind);
      behind += static_cast<double>(part[i]);
    }
    put(out.weights + first, weights, count);
    for (int64_t i = 0; i < count; i += kLanes) {
      store(own + i, load(own + i) * load(chunk.deltas + i) * load(chunk.slope + i));
    }
    float* gradient = out.gradient + 4 * first;
    for (int64_t i = 0; i < count; ++i) {
      for (int k = 0; k < 3; ++k) gradient[4 * i + k] = chunk.rgb[k][i];
      gradient[4 * i + 3] = own[i];
    }
    last = first;
  }
}

}  // namespace

void render_loss_rays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin, int64_t end) {
  Chunk chunk;
  for (int64_t ray = begin; ray < end; ++ray) render_ray(in, out, ray, in.offsets[ray], in.offsets[ray + 1], chunk);
}

void render_loss_strays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin, int64_t end) {
  Chunk chunk;
  for (int64_t first = begin; first < end; first += kChunk) {
    const int64_t count = end - first < kChunk ? end - first : kChunk;
    activate(in, first, count, chunk);
    put(out.density + first, chunk.density, count);
    for (int64_t i = first; i < first + count; ++i) {
      out.weights[i] = 0.0f;
      for (int k = 0; k < 4; ++k) out.gradient[4 * i + k] = 0.0f;
    }
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
