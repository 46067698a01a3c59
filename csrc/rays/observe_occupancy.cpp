// Only the cells of the samples are touched; a step has some thousands of them, and the grid a quarter of a million
// cells. First the threads find the cells of samples and what these make of them. A cell may be named more than once,
// so then the grid is cut into parts: in each one thread goes through the samples in their order.
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
      if (cells[i] >= 0) values[i] = observed_density(in, i);
    }
  });
  const int64_t all = in.x * in.y * in.z, parts = std::max<int64_t>(1, std::min<int64_t>(threads, all));
  parallel_for(parts, 1, threads, [&](int64_t part) {
    const auto first = static_cast<uint32_t>(all * part / parts),
               size = static_cast<uint32_t>(all * (part + 1) / parts) - first;
    const auto each = [&](const auto& body) {
      for (int64_t i = 0; i < in.m; ++i) {
        if (static_cast<uint32_t>(cells[i]) - first < size) body(density[cells[i]], values[i], occupied[cells[i]]);
      }
    };
    // A cell gets what one of its samples makes of it, and then the most.
    each([&](float& kept, float& value, uint8_t&) { value = std::max(kept * in.decay, value); });
    each([&](float& kept, float& value, uint8_t&) { kept = value; });
    each([&](float& kept, float& value, uint8_t& filled) {
      kept = std::max(kept, value);
      // Other threads read the lines of cells that stay as they are.
      if (const bool now = kept >= in.threshold; now != (filled != 0)) filled = now;
    });
  });
}

}  // namespace voronerf
