// Only the cells of the samples are touched; a step has some thousands of them, and the grid a quarter of a million
// cells. A cell may be named more than once: all fade first, from what they were, then each sample may raise its cell.
// The passes are serial, being a fraction of what rendering the samples took.
#include "rays/observe_occupancy.h"

#include <algorithm>

#include "rays/observe_occupancy_math.h"

namespace voronerf {

void observe_occupancy_cpu(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                           int /*threads*/) {
  for (int64_t i = 0; i < in.m; ++i) {
    const int64_t cell = observed_cell(in, i);
    cells[i] = static_cast<int32_t>(cell);
    before[i] = density[cell];
  }
  for (int64_t i = 0; i < in.m; ++i) density[cells[i]] = before[i] * in.decay;
  for (int64_t i = 0; i < in.m; ++i) {
    float& kept = density[cells[i]];
    kept = std::max(kept, observed_density(in, i));
    occupied[cells[i]] = kept >= in.threshold;
  }
}

}  // namespace voronerf
