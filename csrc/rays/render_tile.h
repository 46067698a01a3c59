// Computes the weights of several rays' samples at once from the networks' outputs; shared by render_loss and
// render_opaque.
//
// `In` has raw [m,4], deltas [m], offsets [r+1], density_scale and activated.
#pragma once

#include "common/elementwise_math.h"
#include "common/memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kChunk = 128;
constexpr float kOpaque = 1e30f;  // replaces infinite density; just as opaque over any length but 0

// Samples [first, first + count) in the order of their rays, padded to whole vectors by samples with delta 0.
struct Chunk {
  alignas(64) float rgb[3][kChunk], shade[3][kChunk];  // shade: gradient of the ray's colour
  alignas(64) float density[kChunk], slope[kChunk];    // slope: derivative of density by raw
  alignas(64) float deltas[kChunk], optical[kChunk], front[kChunk];
  alignas(64) float light[kChunk], weights[kChunk];    // light: fraction that reaches a sample
  alignas(64) float part[kChunk], of_optical[kChunk];  // terms in the gradient of the optical depth
};

VN_INLINE F32 finite(F32 density) {
  return density > splat(kOpaque) ? splat(kOpaque) : density;  // NaN stays NaN
}

template <typename In>
VN_INLINE void activate(const In& in, int64_t first, int64_t count, Chunk& chunk) {
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
  if (in.activated) {
    for (int64_t i = 0; i < count; i += kLanes) {
      const F32 density = load(chunk.density + i);
      store(chunk.slope + i, density > splat(kOpaque) ? splat(0.0f) : splat(1.0f));
      store(chunk.optical + i, finite(density) * load(chunk.deltas + i));
    }
    return;
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

// Returns exp(-x), 0 for values too small for float32.
VN_INLINE F32 transmittance(F32 x) {
  const F32 minus = splat(0.0f) - x;
  return minus < splat(-87.0f) ? splat(0.0f) : exponential(minus);
}

// Computes the transmittance in front of each sample (`light`) and the sample's weight, from its optical depth and the
// optical depth in front of it.
VN_INLINE void weigh(int64_t count, Chunk& chunk) {
  for (int64_t i = count; i % kLanes != 0; ++i) chunk.front[i] = 0.0f;
  for (int64_t i = 0; i < count; i += kLanes) {
    const F32 light = transmittance(load(chunk.front + i));
    store(chunk.light + i, light);
    store(chunk.weights + i, light * (splat(0.0f) - exponential_minus_one(splat(0.0f) - load(chunk.optical + i))));
  }
}

// Calls run(ray, begin, end) for each of the rays `from` to `to`, with the range of the ray's samples in the chunk.
template <typename In, typename Run>
VN_INLINE void each_ray(const In& in, int64_t from, int64_t to, int64_t first, int64_t count, const Run& run) {
  for (int64_t ray = from; ray < to; ++ray) {
    const int64_t begin = in.offsets[ray] - first, end = in.offsets[ray + 1] - first;
    run(ray - from, begin < 0 ? 0 : begin, end < count ? end : count);
  }
}

// Computes the optical depth in front of each sample, and advances `front`, the rays' optical depths so far.
template <typename In>
VN_INLINE void pass(const In& in, int64_t from, int64_t to, int64_t first, int64_t count, double* front, Chunk& chunk) {
  each_ray(in, from, to, first, count, [&](int64_t ray, int64_t begin, int64_t end) {
    double before = front[ray];
    for (int64_t i = begin; i < end; ++i) {
      chunk.front[i] = static_cast<float>(before);
      before += static_cast<double>(chunk.optical[i]);
    }
    front[ray] = before;
  });
}

// Calls run(from, to) for groups of rays whose samples fit in one chunk, or for one longer ray.
template <typename In, typename Run>
VN_INLINE void each_chunk(const In& in, int64_t begin, int64_t end, const Run& run) {
  for (int64_t from = begin, to; from < end; from = to) {
    to = from + 1;
    while (to < end && in.offsets[to + 1] - in.offsets[from] <= kChunk) ++to;
    run(from, to);
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
