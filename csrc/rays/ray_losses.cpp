// Rays are independent, and one thread sums their losses, so results do not depend on the number of threads.
#include "rays/ray_losses.h"

#include <algorithm>
#include <cmath>

#include "common/parallel.h"
#include "rays/ray_offsets.h"
#include "rays/render_loss_math.h"

namespace voronerf {

namespace {

constexpr float kLeast = 1e-3f;  // minimum light near a point for a gradient

// Adds the losses of rays, or of triples of rays, in order: `loss_of` returns the loss of one.
template <typename LossOf>
void add_losses(int64_t count, int64_t run, float share, float* of_rays, float* loss, int threads,
                const LossOf& loss_of) {
  parallel_for(count, run, threads, [&](int64_t i) { of_rays[i] = loss_of(i); });
  double sum = 0.0;
  for (int64_t i = 0; i < count; ++i) sum += static_cast<double>(of_rays[i]);
  *loss += share * static_cast<float>(sum);
}

float sparse_depth_of(const SparseDepthInputs& in, int64_t ray, float share, float* of_weights) {
  const auto near_point = [&](int64_t i) {
    return std::fabs(in.depths[i] - in.distances[ray]) <= in.nearby * in.distances[ray] + in.deltas[i];
  };
  const int64_t begin = in.offsets[ray], end = in.offsets[ray + 1];
  double sum = 0.0;
  for (int64_t i = begin; i < end; ++i) sum += near_point(i) ? static_cast<double>(in.weights[i]) : 0.0;
  const float total = static_cast<float>(sum);
  if (!(total > kLeast)) return total == total ? -std::log(kLeast) : total;
  for (int64_t i = begin; i < end; ++i) of_weights[i] -= near_point(i) ? share / total : 0.0f;
  return -std::log(total);
}

float disparity_of(const SmoothDepthInputs& in, int64_t ray) {
  double left = 1.0, sum = 0.0;
  for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
    left -= static_cast<double>(in.weights[i]);
    sum += static_cast<double>(in.weights[i]) / static_cast<double>(in.depths[i]);
  }
  return static_cast<float>(sum + left / static_cast<double>(in.far[ray]));
}

// Adds the gradient with respect to the weights of a ray's samples. to_disparity: the gradient with respect to the
// ray's disparity.
void bend(const SmoothDepthInputs& in, int64_t ray, float to_disparity, float* of_weights) {
  for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
    of_weights[i] += to_disparity * (1.0f / in.depths[i] - 1.0f / in.far[ray]);
  }
}

// Returns the decrease of the opacity from a sample to the next, 0 unless the next sample lies directly behind it.
float fall(const SurfaceInputs& in, int64_t i, float opacity, float next) {
  const bool beside = in.depths[i + 1] - in.depths[i] < in.deltas[i] + in.deltas[i + 1];
  return beside ? std::max(opacity - next, 0.0f) : 0.0f;
}

// The position of a sample (`place`) is its disparity, which decreases along the ray. Samples are ignored if the
// transmittance in front of them (`light`) is at most `hidden`.
float surface_of(const SurfaceInputs& in, int64_t ray, float share, float* of_weights, float* of_density) {
  const int64_t begin = in.offsets[ray], last = in.offsets[ray + 1];
  int64_t end = begin;
  double after = 0.0, moment_after = 0.0;
  for (; end < last && !(1.0 - after <= static_cast<double>(in.hidden)); ++end) {
    after += static_cast<double>(in.weights[end]);
    moment_after += static_cast<double>(in.weights[end] * (1.0f / in.depths[end]));
  }
  const float scale = in.distortion / (1.0f / in.near[ray] - 1.0f / in.far[ray]);
  double light = 1.0, moment = 0.0, sum = 0.0;
  float fallen = 0.0f;  // the fall from the sample in front, times its weight
  for (int64_t i = begin; i < end; ++i) {
    const float weight = in.weights[i], place = 1.0f / in.depths[i], length = in.deltas[i] * place * place;
    after -= static_cast<double>(weight);
    moment_after -= static_cast<double>(weight * place);
    const float opacity = static_cast<float>(weight / light);
    const float spread = static_cast<float>(moment - moment_after - ((1.0 - light) - after) * place);
    light -= static_cast<double>(weight);
    moment += static_cast<double>(weight * place);
    const float own = i + 1 < end ? fall(in, i, opacity, static_cast<float>(in.weights[i + 1] / light)) : 0.0f;
    const float squared = in.orientation * own * own;
    of_weights[i] += share * (scale * (2.0f * spread + 2.0f / 3.0f * weight * length) + squared);
    of_density[i] += share * 2.0f * in.orientation * (weight * own - fallen) * (1.0f - opacity) * in.deltas[i];
    sum += static_cast<double>(weight * (scale * (spread + weight * length / 3.0f) + squared));
    fallen = weight * own;
  }
  return static_cast<float>(sum);
}

}  // namespace

void sparse_depth_loss_cpu(const SparseDepthInputs& in, float* loss, float* of_weights, float* of_rays, int threads) {
  check_ray_offsets("sparse_depth_loss", in.offsets, in.r, in.m);
  if (in.s == 0) return;
  const float share = in.factor / static_cast<float>(in.s);
  add_losses(in.s, 64, share, of_rays, loss, threads,
             [&](int64_t ray) { return sparse_depth_of(in, ray, share, of_weights); });
}

void smooth_depth_loss_cpu(const SmoothDepthInputs& in, float* loss, float* of_weights, float* of_rays, int threads) {
  check_ray_offsets("smooth_depth_loss", in.offsets, in.r, in.m);
  const int64_t triples = in.triples, first = in.r - 3 * triples;
  if (triples == 0) return;
  const float share = in.factor / static_cast<float>(triples);
  add_losses(triples, 24, share, of_rays, loss, threads, [&](int64_t triple) {
    const int64_t middle = first + triple, one = middle + triples, other = one + triples;
    const float at_middle = disparity_of(in, middle), at_sides = disparity_of(in, one) + disparity_of(in, other);
    const float bent = std::log(at_sides / (2.0f * at_middle));
    const float slope = 2.0f * share * bent * ray_loss_slope(bent * bent, in.edge);
    bend(in, middle, -slope / at_middle, of_weights);
    bend(in, one, slope / at_sides, of_weights);
    bend(in, other, slope / at_sides, of_weights);
    return ray_loss(bent * bent, in.edge);
  });
}

void surface_loss_cpu(const SurfaceInputs& in, float* loss, float* of_weights, float* of_density, float* of_rays,
                      int threads) {
  check_ray_offsets("surface_loss", in.offsets, in.r, in.m);
  if (in.r == 0) return;
  const float share = 1.0f / static_cast<float>(in.r);
  add_losses(in.r, 32, share, of_rays, loss, threads,
             [&](int64_t ray) { return surface_of(in, ray, share, of_weights, of_density); });
}

}  // namespace voronerf
