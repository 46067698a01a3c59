// Only the cells of the samples are touched; a step has some thousands of them, and the grid a quarter of a million
// cells. First the threads find the cells of samples and what these make of them. A cell may be named more than once,
// so then the grid is cut into a part for each thread, to which the samples of a run were sorted before.
#include "rays/observe_occupancy.h"

#include <algorithm>
#include <vector>

#include "common/parallel.h"
#include "rays/observe_occupancy_math.h"

namespace voronerf {

void observe_occupancy_cpu(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* values,
                           int threads) {
  constexpr int64_t kRun = 1024;
  const int64_t runs = (in.m + kRun - 1) / kRun, all = in.x * in.y * in.z;
  const int64_t parts = std::max<int64_t>(1, std::min<int64_t>(threads, all));
  std::vector<int64_t> ends(static_cast<size_t>(runs * parts));  // of the samples of a run in a part
  parallel_for(runs, 1, threads, [&](int64_t run) {
    const int64_t begin = run * kRun, end = std::min<int64_t>(in.m, begin + kRun);
    int32_t found[kRun];
    float made[kRun];
    int64_t count = 0;
    for (int64_t i = begin; i < end; ++i) {
      const int64_t cell = observed_cell(in, i);
      if (!observes(in, i, cell)) continue;
      __builtin_prefetch(density + cell, 1);
      found[count] = static_cast<int32_t>(cell);
      made[count++] = observed_density(in, i);
    }
    for (int64_t i = 0; i < count; ++i) made[i] = std::max(density[found[i]] * in.decay, made[i]);
    int64_t place = begin;
    for (int64_t part = 0; part < parts; ++part) {
      const auto first = static_cast<uint32_t>(all * part / parts),
                 size = static_cast<uint32_t>(all * (part + 1) / parts) - first;
      for (int64_t i = 0; i < count; ++i) {
        if (place == end) break;
        cells[place] = found[i];
        values[place] = made[i];
        place += static_cast<uint32_t>(found[i]) - first < size;  // without a branch, which nothing could predict
      }
      ends[static_cast<size_t>(run * parts + part)] = place;
    }
  });
  parallel_for(parts, 1, threads, [&](int64_t part) {
    const auto each = [&](const auto& body) {
      for (int64_t run = 0; run < runs; ++run) {
        const auto own = static_cast<size_t>(run * parts + part);
        for (int64_t i = part == 0 ? run * kRun : ends[own - 1]; i < ends[own]; ++i) body(cells[i], values[i]);
      }
    };
    // A cell gets what one of its samples makes of it, and then the most.
    each([&](int32_t cell, float value) { density[cell] = value; });
    each([&](int32_t cell, float value) {
      density[cell] = std::max(density[cell], value);
      // Other threads read the lines of cells that stay as they are.
      if (const bool now = density[cell] >= in.threshold; now != (occupied[cell] != 0)) occupied[cell] = now;
    });
  });
}

}  // namespace voronerf
