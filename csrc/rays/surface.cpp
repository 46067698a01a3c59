// Rays are independent, and one thread sums their losses, so results do not depend on the number of threads.
#include "rays/surface.h"

#include <algorithm>

#include "common/parallel.h"
#include "rays/density_slope.h"
#include "rays/ray_offsets.h"

namespace voronerf {

namespace {

// Returns the decrease of the opacity from a sample to the next, 0 unless the next sample lies directly behind it.
float fall(const Surface& in, int64_t i, float opacity, float next) {
  const bool beside = in.depths[i + 1] - in.depths[i] < in.deltas[i] + in.deltas[i + 1];
  return beside ? std::max(opacity - next, 0.0f) : 0.0f;
}

// Returns the loss of a ray, and adds its gradient to the gradient of the samples. The position of a sample (`place`)
// is its disparity, which decreases along the ray. The loop runs from the last sample to the first, since each sample
// needs sums over the samples behind it. Samples are ignored if the transmittance in front of them is at most `hidden`.
float learn_ray(const Surface& in, int64_t ray, float share, float* gradient) {
  const int64_t begin = in.offsets[ray];
  int64_t end = begin;
  double light = 0.0, moment = 0.0;
  for (const int64_t last = in.offsets[ray + 1]; end < last && !(1.0 - light <= static_cast<double>(in.hidden));
       ++end) {
    light += static_cast<double>(in.weights[end]);
    moment += static_cast<double>(in.weights[end] / in.depths[end]);
  }
  if (begin == end) return 0.0f;
  const float scale = in.distortion / (1.0f / in.near[ray] - 1.0f / in.far[ray]);
  double through = 1.0 - light, after = 0.0, moment_after = 0.0, behind = 0.0, sum = 0.0;
  float opacity = static_cast<float>(in.weights[end - 1] / (through + in.weights[end - 1])), own_fall = 0.0f;
  for (int64_t i = end; i-- > begin;) {
    const float weight = in.weights[i], place = 1.0f / in.depths[i], length = in.deltas[i] * place * place;
    const double reached = through + weight, before = 1.0 - reached,
                 moment_before = moment - moment_after - weight * place;
    const float spread = static_cast<float>(moment_before - moment_after - (before - after) * place);
    float to_opacity = 2.0f * weight * own_fall, opacity_before = 0.0f, fall_before = 0.0f;
    if (i > begin) {
      const float weight_before = in.weights[i - 1];
      opacity_before = static_cast<float>(weight_before / (reached + weight_before));
      fall_before = fall(in, i - 1, opacity_before, opacity);
      to_opacity -= 2.0f * weight_before * fall_before;
    }
    const float fallen = in.orientation * own_fall * own_fall;
    const float to_weight = scale * (2.0f * spread + 2.0f / 3.0f * weight * length) + fallen;
    sum += weight * (scale * (spread + weight * length / 3.0f) + fallen);
    const float to_optical =
        static_cast<float>(through * to_weight - behind) + in.orientation * to_opacity * (1.0f - opacity);
    gradient[4 * i + 3] +=
        share * in.deltas[i] * to_optical * density_slope(in.density[i], in.density_scale, in.activated);
    through = reached;
    after += weight;
    moment_after += weight * place;
    behind += weight * to_weight;
    opacity = opacity_before;
    own_fall = fall_before;
  }
  return static_cast<float>(sum);
}

}  // namespace

void surface_gradient_cpu(const Surface& in, float* loss, float* gradient, float* of_rays, int threads) {
  constexpr int64_t kRays = 32;  // rays of a task
  check_ray_offsets("surface_gradient", in.offsets, in.r, in.m);
  if (in.r == 0) return;
  const float share = 1.0f / static_cast<float>(in.r);
  parallel_for(in.r, kRays, threads, [&](int64_t ray) { of_rays[ray] = learn_ray(in, ray, share, gradient); });
  double sum = 0.0;
  for (int64_t ray = 0; ray < in.r; ++ray) sum += static_cast<double>(of_rays[ray]);
  *loss += static_cast<float>(share * sum);
}

}  // namespace voronerf
