// The CPU kernels of render_loss, compiled once per instruction set.
//
// They compute activations, volume rendering as in composite_isa.cpp, and the squared error of the colour. With an
// occupancy grid a ray has fewer samples than a vector has lanes, so the samples of several rays are processed
// together. The forward pass runs over chunks that stay in the L1 cache, until the colours and their gradients are
// known. The backward pass runs back and sums over the samples behind. Only sums along a ray are serial. Rays that fit
// in one chunk are activated once. The samples of a longer ray are activated again in the backward pass; the optical
// depth in front of them is stored in the memory of the density's gradient. Rays without a target have no backward
// pass.
#include "rays/render_loss_isa.h"

#include "rays/render_loss_math.h"
#include "rays/render_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// The sums along the rays of a task.
struct Sums {
  double front[kRenderLossRays], behind[kRenderLossRays], light[3][kRenderLossRays];
  float slopes[3][kRenderLossRays];
};

VN_INLINE void put(float* to, const float* from, int64_t count) { __builtin_memcpy(to, from, sizeof(float) * count); }

VN_INLINE F32 only(Bits lanes, F32 value) { return reinterpret_cast<F32>(lanes & reinterpret_cast<Bits>(value)); }

VN_INLINE void forward(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t from, int64_t to,
                       int64_t first, int64_t count, bool together, Chunk& chunk, Sums& sums) {
  activate(in, first, count, chunk);
  put(out.density + first, chunk.density, count);
  pass(in, from, to, first, count, sums.front, chunk);
  weigh(count, chunk);
  put(out.weights + first, chunk.weights, count);
  for (int64_t i = 0; i < count; i += kLanes) {
    for (int k = 0; k < 3; ++k) store(chunk.shade[k] + i, load(chunk.weights + i) * load(chunk.rgb[k] + i));
  }
  each_ray(in, from, to, first, count, [&](int64_t ray, int64_t begin, int64_t end) {
    for (int k = 0; k < 3; ++k) {
      for (int64_t i = begin; i < end; ++i) sums.light[k][ray] += static_cast<double>(chunk.shade[k][i]);
    }
  });
  for (int64_t i = 0; !together && i < count; ++i) out.gradient[4 * (first + i) + 3] = chunk.front[i];
}

// Returns whether a ray has a target colour.
VN_INLINE bool has_target(const RenderLossInputs& in, int64_t ray) { return ray < in.r - 3 * in.triples; }

// Computes the colours of rays, their errors, and the gradients of the colours.
VN_INLINE void compare(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t from, int64_t to, Sums& sums) {
  const float share = 2.0f / (3.0f * static_cast<float>(in.r));
  for (int64_t ray = from; ray < to; ++ray) {
    const float* background = in.background;
    if (background != nullptr && in.background_per_ray) background += 3 * ray;
    float lanes[kLanes];
    store(lanes, transmittance(splat(static_cast<float>(sums.front[ray - from]))));
    const float left = lanes[0];
    float off[3], error = 0.0f;
    for (int k = 0; k < 3; ++k) {
      const float shown = background == nullptr ? 0.0f : background[k];
      const float colour = static_cast<float>(sums.light[k][ray - from]) + left * shown;
      off[k] = colour - in.target[3 * ray + k];
      out.colour[3 * ray + k] = colour;
      error += off[k] * off[k];
    }
    const float scale = share * ray_loss_slope(error, in.robust);
    double behind = 0.0;
    for (int k = 0; k < 3; ++k) {
      const float slope = off[k] * scale;
      sums.slopes[k][ray - from] = slope;
      behind += static_cast<double>(slope) * (background == nullptr ? 0.0f : background[k]) * left;
    }
    out.error[ray] = has_target(in, ray) ? error : 0.0f;
    sums.behind[ray - from] = behind;
  }
}

// Turns the gradients of the rays' colours into gradients of the samples' colours, which replace the colours, and into
// the gradients of the optical depths without the terms of samples behind.
template <bool Activated>
VN_INLINE void slopes(float hidden, int64_t count, Chunk& chunk) {
  for (int64_t i = 0; i < count; i += kLanes) {
    const F32 light = load(chunk.light + i), weight = load(chunk.weights + i);
    const Bits seen = ~(light <= splat(hidden));  // true for NaN
    F32 gradient = splat(0.0f);
    for (int k = 0; k < 3; ++k) {
      const F32 value = load(chunk.rgb[k] + i), shade = load(chunk.shade[k] + i);
      gradient = fma(shade, value, gradient);
      const F32 of_colour = weight * shade;
      store(chunk.rgb[k] + i, only(seen, Activated ? of_colour : of_colour * (value * (splat(1.0f) - value))));
    }
    store(chunk.part + i, gradient * weight);
    store(chunk.of_optical + i, gradient * (light * transmittance(load(chunk.optical + i))));
    store(chunk.slope + i, only(seen, load(chunk.slope + i)));
  }
}

VN_INLINE void backward(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t from, int64_t to,
                        int64_t first, int64_t count, bool together, Chunk& chunk, Sums& sums) {
  if (!together) {
    activate(in, first, count, chunk);
    for (int64_t i = 0; i < count; ++i) chunk.front[i] = out.gradient[4 * (first + i) + 3];
    weigh(count, chunk);
  }
  each_ray(in, from, to, first, count, [&](int64_t ray, int64_t begin, int64_t end) {
    for (int k = 0; k < 3; ++k) {
      for (int64_t i = begin; i < end; ++i) chunk.shade[k][i] = sums.slopes[k][ray];
    }
  });
  for (int k = 0; k < 3; ++k) {
    for (int64_t i = count; i % kLanes != 0; ++i) chunk.shade[k][i] = 0.0f;
  }
  if (in.activated) {
    slopes<true>(in.hidden, count, chunk);
  } else {
    slopes<false>(in.hidden, count, chunk);
  }
  each_ray(in, from, to, first, count, [&](int64_t ray, int64_t begin, int64_t end) {
    double behind = sums.behind[ray];
    for (int64_t i = end; i-- > begin;) {
      chunk.of_optical[i] = static_cast<float>(static_cast<double>(chunk.of_optical[i]) - behind);
      behind += static_cast<double>(chunk.part[i]);
    }
    sums.behind[ray] = behind;
  });
  for (int64_t i = 0; i < count; i += kLanes) {
    store(chunk.of_optical + i, load(chunk.of_optical + i) * load(chunk.deltas + i) * load(chunk.slope + i));
  }
  float* gradient = out.gradient + 4 * first;
  for (int64_t i = 0; i < count; ++i) {
    for (int k = 0; k < 3; ++k) gradient[4 * i + k] = chunk.rgb[k][i];
    gradient[4 * i + 3] = chunk.of_optical[i];
  }
}

VN_INLINE void reset(int64_t rays, Sums& sums) {
  for (int64_t ray = 0; ray < rays; ++ray) {
    sums.front[ray] = 0.0;
    for (int k = 0; k < 3; ++k) sums.light[k][ray] = 0.0;
  }
}

// Renders the rays of one call of each_chunk.
VN_INLINE void render_rays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t from, int64_t to,
                           Chunk& chunk, Sums& sums) {
  const int64_t begin = in.offsets[from], end = in.offsets[to];
  const bool together = end - begin <= kChunk;
  reset(to - from, sums);
  for (int64_t first = begin; first < end; first += kChunk) {
    forward(in, out, from, to, first, end - first < kChunk ? end - first : kChunk, together, chunk, sums);
  }
  compare(in, out, from, to, sums);
  if (!has_target(in, from)) {
    for (int64_t i = 4 * begin; i < 4 * end; ++i) out.gradient[i] = 0.0f;
    return;
  }
  for (int64_t last = end; last > begin;) {
    const int64_t count = (last - begin - 1) % kChunk + 1;
    last -= count;
    backward(in, out, from, to, last, count, together, chunk, sums);
  }
}

}  // namespace

void render_loss_rays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin, int64_t end) {
  Chunk chunk;
  Sums sums;
  each_chunk(in, begin, end, [&](int64_t from, int64_t to) { render_rays(in, out, from, to, chunk, sums); });
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
