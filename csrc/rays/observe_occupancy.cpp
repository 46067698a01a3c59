// Only the cells of the samples are touched; a step has some thousands of them, and the grid a quarter of a million
// cells. A cell may be named more than once: all fade first, from what they were, then each sample may raise its cell.
// The passes are serial, being a fraction of what rendering the samples took.
#include "rays/observe_occupancy.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace voronerf {

namespace {

// What a sample says of its cell: its density, or 0 if less than the share `hidden` of the light reaches it.
float seen_density(const ObservedSamples& in, int64_t i) {
  const float density = std::isnan(in.sigma[i]) ? std::numeric_limits<float>::infinity() : in.sigma[i];
  const float thickness = density * in.deltas[i];
  // 1 - exp(-t) <= min(t, 1), which spares most samples the function.
  if (in.weights[i] > in.hidden * std::min(thickness, 1.0f)) return density;
  return in.weights[i] > in.hidden * -std::expm1(-thickness) ? density : 0.0f;
}

}  // namespace

void observe_occupancy_cpu(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                           int /*threads*/) {
  const int64_t size[3] = {in.x, in.y, in.z};
  for (int64_t i = 0; i < in.m; ++i) {
    int64_t cell = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const float extent = in.box[3 + axis] - in.box[axis];
      const float place = (in.positions[3 * i + axis] - in.box[axis]) / extent * static_cast<float>(size[axis]);
      // In this order NaN becomes 0.
      const float inside = place > 0.0f ? std::min(place, static_cast<float>(size[axis] - 1)) : 0.0f;
      cell = cell * size[axis] + static_cast<int64_t>(inside);
    }
    cells[i] = static_cast<int32_t>(cell);
    before[i] = density[cell];
  }
  for (int64_t i = 0; i < in.m; ++i) density[cells[i]] = before[i] * in.decay;
  for (int64_t i = 0; i < in.m; ++i) {
    float& kept = density[cells[i]];
    kept = std::max(kept, seen_density(in, i));
    occupied[cells[i]] = kept >= in.threshold;
  }
}

}  // namespace voronerf
