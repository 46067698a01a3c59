// Only the cells of the samples are touched; a step has some thousands of them, and the grid a quarter of a million
// cells. A cell may be named more than once. So first every sample finds what it makes of its cell alone, which the
// threads share; then a cell gets that of any of its samples, and then the largest.
#include "rays/observe_occupancy.h"

#include <algorithm>

#include "common/parallel.h"
#include "rays/observe_occupancy_math.h"

namespace voronerf {

void observe_occupancy_cpu(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* values,
                           int threads) {
  constexpr int64_t kRun = 1024;
  parallel_for((in.m + kRun - 1) / kRun, 1, threads, [&](int64_t run) {
    const int64_t begin = run * kRun, end = std::min<int64_t>(in.m, begin + kRun);
    for (int64_t i = begin; i < end; ++i) {
      const int64_t cell = observed_cell(in, i);
      cells[i] = observes(in, i, cell) ? static_cast<int32_t>(cell) : -1;
      __builtin_prefetch(density + cell, 1);
      __builtin_prefetch(occupied + cell, 1);
    }
    for (int64_t i = begin; i < end; ++i) {
      if (cells[i] < 0) continue;
      values[i] = std::max(density[cells[i]] * in.decay, observed_density(in, i));
    }
  });
  for (int64_t i = 0; i < in.m; ++i) {
    if (cells[i] >= 0) density[cells[i]] = values[i];
  }
  for (int64_t i = 0; i < in.m; ++i) {
    if (cells[i] < 0) continue;
    float& kept = density[cells[i]];
    kept = std::max(kept, values[i]);
    occupied[cells[i]] = kept >= in.threshold;
  }
}

}  // namespace voronerf
