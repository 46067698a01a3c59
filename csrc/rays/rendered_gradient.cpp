// Walks along each ray once, from its end, with two running sums over the samples j behind the current sample: of w_j
// and of w_j * dL/dw_j, where w_j are the weights. The first sum plus the transmittance of the whole ray is the
// transmittance behind the sample, so no exponential of an optical depth is recomputed. The second sum is subtracted in
// the gradient of the sample's optical depth. Rays are independent, so results do not depend on the number of threads.
// A ray without gradients is left out; colours are activated only if a gradient needs them.
#include "rays/rendered_gradient.h"

#include <cmath>

#include "common/parallel.h"
#include "rays/ray_offsets.h"

namespace voronerf {

namespace {

float sigmoid(float x) { return 1.0f / (1.0f + std::exp(-x)); }

float entry(const float* values, int64_t i) { return values == nullptr ? 0.0f : values[i]; }

// Returns whether the colour of a sample has a gradient of its own.
bool is_coloured(const RenderedGradient& in, int64_t i) {
  const float* of_rgb = in.of_rgb == nullptr ? nullptr : in.of_rgb + 3 * i;
  return of_rgb != nullptr && (of_rgb[0] != 0.0f || of_rgb[1] != 0.0f || of_rgb[2] != 0.0f);
}

void learn_ray(const RenderedGradient& in, int64_t ray, float* gradient) {
  float of_colour[3], of_light = entry(in.of_opacity, ray);  // gradients per unit of weight
  bool ray_coloured = false, learns = of_light != 0.0f || entry(in.of_depth, ray) != 0.0f;
  for (int k = 0; k < 3; ++k) {
    of_colour[k] = entry(in.of_colour, 3 * ray + k);
    ray_coloured |= of_colour[k] != 0.0f;
    of_light -= of_colour[k] * entry(in.background, in.background_per_ray ? 3 * ray + k : k);
  }
  const double hidden = in.hidden > 0.0f ? static_cast<double>(in.hidden) : -1.0;
  double through = 1.0, behind = 0.0;
  for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
    through -= static_cast<double>(in.weights[i]);
    learns |= entry(in.of_weights, i) != 0.0f || entry(in.of_density, i) != 0.0f || is_coloured(in, i);
  }
  if (!learns && !ray_coloured) return;
  for (int64_t i = in.offsets[ray + 1]; i-- > in.offsets[ray];) {
    float rgb[3], of_weight = of_light + entry(in.of_weights, i);
    if (in.of_depth != nullptr) of_weight += in.of_depth[ray] * in.depths[i];
    const bool coloured = ray_coloured || is_coloured(in, i);
    for (int k = 0; coloured && k < 3; ++k) {
      const float raw = in.raw[4 * i + k];
      rgb[k] = in.activated ? raw : sigmoid(raw);
      of_weight += of_colour[k] * rgb[k];
    }
    const double weight = static_cast<double>(in.weights[i]), worth = static_cast<double>(of_weight);
    if (!(through + weight <= hidden)) {
      const float of_depth = static_cast<float>(through * worth - behind);  // gradient of the optical depth
      const float of_density = in.deltas[i] * of_depth + entry(in.of_density, i);
      gradient[4 * i + 3] += of_density * (in.activated ? 1.0f : in.density_scale * sigmoid(in.raw[4 * i + 3]));
      for (int k = 0; coloured && k < 3; ++k) {
        const float of_rgb = in.weights[i] * of_colour[k] + entry(in.of_rgb, 3 * i + k);
        gradient[4 * i + k] += in.activated ? of_rgb : of_rgb * rgb[k] * (1.0f - rgb[k]);
      }
    }
    through += weight;
    behind += weight * worth;
  }
}

}  // namespace

void rendered_gradient_cpu(const RenderedGradient& in, float* gradient, int threads) {
  constexpr int64_t kRays = 64;  // rays of a task
  check_ray_offsets("rendered_gradient", in.offsets, in.r, in.m);
  parallel_for(in.r, kRays, threads, [&](int64_t ray) { learn_ray(in, ray, gradient); });
}

}  // namespace voronerf
