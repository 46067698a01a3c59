// Triples are independent, and one thread sums the losses, so results do not depend on the number of threads.
#include "rays/smooth_depth.h"

#include <cmath>

#include "common/parallel.h"
#include "rays/density_slope.h"
#include "rays/ray_offsets.h"
#include "rays/render_loss_math.h"

namespace voronerf {

namespace {

float disparity_of(const SmoothDepth& in, int64_t ray) {
  double sum = light_left(in, ray) / static_cast<double>(in.far[ray]);
  for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
    sum += static_cast<double>(in.weights[i]) / static_cast<double>(in.depths[i]);
  }
  return static_cast<float>(sum);
}

// Adds the gradient of the loss with respect to the outputs for a ray's samples. to_disparity: the gradient with
// respect to the ray's disparity. The loop runs from the last sample to the first, since each sample needs sums over
// the samples behind it.
void learn_ray(const SmoothDepth& in, int64_t ray, float to_disparity, float* gradient) {
  double through = light_left(in, ray), behind = through / static_cast<double>(in.far[ray]);
  for (int64_t i = in.offsets[ray + 1]; i-- > in.offsets[ray];) {
    const double disparity = 1.0 / static_cast<double>(in.depths[i]), weight = static_cast<double>(in.weights[i]);
    const float to_density = to_disparity * in.deltas[i] * static_cast<float>(through * disparity - behind);
    if (!(through + weight <= static_cast<double>(in.hidden))) {
      gradient[4 * i + 3] += to_density * density_slope(in.density[i], in.density_scale, in.activated);
    }
    through += weight;
    behind += weight * disparity;
  }
}

}  // namespace

void smooth_depth_gradient_cpu(const SmoothDepth& in, float* loss, float* gradient, float* of_rays, int threads) {
  constexpr int64_t kTriples = 24;  // triples of a task
  check_ray_offsets("smooth_depth_gradient", in.offsets, in.r, in.m);
  const int64_t triples = in.triples, first = in.r - 3 * triples;
  if (triples == 0) return;
  const float share = in.factor / static_cast<float>(triples);
  parallel_for(triples, kTriples, threads, [&](int64_t triple) {
    const int64_t middle = first + triple, one = middle + triples, other = one + triples;
    const float at_middle = disparity_of(in, middle), at_sides = disparity_of(in, one) + disparity_of(in, other);
    const float bent = std::log(at_sides / (2.0f * at_middle));
    const float slope = 2.0f * share * bent * ray_loss_slope(bent * bent, in.edge);
    learn_ray(in, middle, -slope / at_middle, gradient);
    learn_ray(in, one, slope / at_sides, gradient);
    learn_ray(in, other, slope / at_sides, gradient);
    of_rays[triple] = ray_loss(bent * bent, in.edge);
  });
  double sum = 0.0;
  for (int64_t triple = 0; triple < triples; ++triple) sum += static_cast<double>(of_rays[triple]);
  *loss += static_cast<float>(share * sum);
}

}  // namespace voronerf
