// Inverse-CDF sampling on the CPU. Sorted targets and bins are merged, so a ray takes s + count steps and needs no
// table of its running mass (float64). Threads share the rays, which are independent.
#include "rays/resample.h"

#include <algorithm>
#include <cmath>

#include "common/parallel.h"

namespace voronerf {

namespace {

// The number of bins and depths of a task.
constexpr int64_t kBlock = 4096;

void resample_ray(const float* weights, const float* edges, const float* uniforms, float* depths, int64_t s,
                  int64_t count) {
  const auto weight = [&](int64_t i) { return std::isfinite(weights[i]) && weights[i] > 0.0f ? weights[i] : 0.0f; };
  double total = 0.0;
  int64_t last = s - 1;
  for (int64_t i = 0; i < s; ++i) {
    total += weight(i);
    if (weight(i) > 0.0f) last = i;
  }
  const bool even = total == 0.0;
  if (even) {
    total = static_cast<double>(s);
    last = s - 1;
  }
  const auto mass = [&](int64_t i) { return even ? 1.0 : static_cast<double>(weight(i)); };
  if (uniforms != nullptr) {
    std::copy(uniforms, uniforms + count, depths);
    // NaN sorts last.
    std::sort(depths, std::partition(depths, depths + count, [](float u) { return !std::isnan(u); }));
  }

  int64_t bin = 0;
  double lower = 0.0, upper = mass(0);
  for (int64_t j = 0; j < count; ++j) {
    double u = (static_cast<double>(j) + 0.5) / static_cast<double>(count);
    if (uniforms != nullptr) u = depths[j] < 0.0f ? 0.0 : depths[j] > 1.0f ? 1.0 : depths[j];
    const double target = u * total;
    // A target on the edge of two bins belongs to the later bin, so a bin without mass is never drawn. The last bin
    // with mass takes targets that round to the end.
    while (bin < last && target >= upper) {
      lower = upper;
      upper += mass(++bin);
    }
    double inside = (target - lower) / mass(bin);
    inside = inside < 0.0 ? 0.0 : inside > 1.0 ? 1.0 : inside;
    const double near = edges[bin], far = edges[bin + 1], depth = near + inside * (far - near);
    depths[j] = static_cast<float>(depth > far ? far : depth);
  }
}

}  // namespace

void resample_cpu(const float* weights, const float* edges, const float* uniforms, float* depths, int64_t r, int64_t s,
                  int64_t count, int threads) {
  const int64_t rays = std::max<int64_t>(kBlock / (s + count), 1);
  parallel_blocks(r, rays, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      resample_ray(weights + i * s, edges + i * (s + 1), uniforms == nullptr ? nullptr : uniforms + i * count,
                   depths + i * count, s, count);
    }
  });
}

}  // namespace voronerf
