// Rays are independent, and one thread sums their losses, so results do not depend on the number of threads.
#include "rays/sparse_depth.h"

#include <cmath>

#include "common/parallel.h"
#include "rays/density_slope.h"
#include "rays/ray_offsets.h"

namespace voronerf {

namespace {

constexpr float kLeast = 1e-3f;  // minimum light near the point for a gradient

bool near_point(const SparseDepth& in, int64_t i, float distance) {
  return std::fabs(in.depths[i] - distance) <= in.nearby * distance + in.deltas[i];
}

float learn_ray(const SparseDepth& in, float share, int64_t begin, int64_t end, float distance, float* gradient) {
  double sum = 0.0;
  for (int64_t i = begin; i < end; ++i) sum += near_point(in, i, distance) ? static_cast<double>(in.weights[i]) : 0.0;
  const float total = static_cast<float>(sum);
  if (!(total > kLeast)) return total == total ? -std::log(kLeast) : total;
  double optical = 0.0, light = 0.0;
  for (int64_t i = begin; i < end; ++i) {
    const bool is_near = near_point(in, i, distance);
    optical += static_cast<double>(in.density[i] * in.deltas[i]);
    light += is_near ? static_cast<double>(in.weights[i]) : 0.0;
    const float through = is_near ? std::exp(-static_cast<float>(optical)) : 0.0f;
    const float to_density = -in.deltas[i] / total * (through - (total - static_cast<float>(light)));
    gradient[4 * i + 3] += share * to_density * density_slope(in.density[i], in.density_scale, in.activated);
  }
  return -std::log(total);
}

}  // namespace

void sparse_depth_gradient_cpu(const SparseDepth& in, float* loss, float* gradient, float* of_rays, int threads) {
  constexpr int64_t kRays = 64;  // rays of a task
  check_ray_offsets("sparse_depth_gradient", in.offsets, in.r, in.m);
  if (in.s == 0) return;
  const float share = in.factor / static_cast<float>(in.s);
  parallel_for(in.s, kRays, threads, [&](int64_t i) {
    of_rays[i] = learn_ray(in, share, in.offsets[i], in.offsets[i + 1], in.distances[i], gradient);
  });
  double sum = 0.0;
  for (int64_t i = 0; i < in.s; ++i) sum += static_cast<double>(of_rays[i]);
  *loss += share * static_cast<float>(sum);
}

}  // namespace voronerf
