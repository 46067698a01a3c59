// observe_occupancy on the CPU. Only voxels with samples are touched: a step has some thousands of samples, the grid a
// quarter of a million voxels. First the threads compute each sample's voxel and the voxel's new density. Several
// samples may share a voxel, so each thread then updates its own part of the grid; the samples of a run (kRun) are
// sorted by part in the first phase.
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
  std::vector<int64_t> ends(static_cast<size_t>(runs * parts));  // ends of the samples of each run and part
  parallel_for(runs, 1, threads, [&](int64_t run) {
    const int64_t begin = run * kRun, end = std::min<int64_t>(in.m, begin + kRun);
    int32_t cell_of[kRun];
    float value_of[kRun];
    int64_t count = 0;
    for (int64_t i = begin; i < end; ++i) {
      const int64_t cell = observed_cell(in, i);
      if (!observes(in, i, cell)) continue;
      __builtin_prefetch(density + cell, 1);
      cell_of[count] = static_cast<int32_t>(cell);
      value_of[count++] = observed_density(in, i);
    }
    for (int64_t i = 0; i < count; ++i) value_of[i] = std::max(density[cell_of[i]] * in.decay, value_of[i]);
    int64_t place = begin;
    for (int64_t part = 0; part < parts; ++part) {
      const auto first = static_cast<uint32_t>(all * part / parts),
                 size = static_cast<uint32_t>(all * (part + 1) / parts) - first;
      for (int64_t i = 0; i < count; ++i) {
        if (place == end) break;
        cells[place] = cell_of[i];
        values[place] = value_of[i];
        place += static_cast<uint32_t>(cell_of[i]) - first < size;  // no branch, since it would be unpredictable
      }
      ends[static_cast<size_t>(run * parts + part)] = place;
    }
  });
  parallel_for(parts, 1, threads, [&](int64_t part) {
    const auto for_each_sample = [&](const auto& body) {
      for (int64_t run = 0; run < runs; ++run) {
        const auto index = static_cast<size_t>(run * parts + part);
        for (int64_t i = part == 0 ? run * kRun : ends[index - 1]; i < ends[index]; ++i) body(cells[i], values[i]);
      }
    };
    // First set each voxel to the value of any of its samples, then raise it to their maximum.
    for_each_sample([&](int32_t cell, float value) { density[cell] = value; });
    for_each_sample([&](int32_t cell, float value) {
      density[cell] = std::max(density[cell], value);
      // Write only on a change, because other threads read the same cache lines.
      if (const bool filled = density[cell] >= in.threshold; filled != (occupied[cell] != 0)) occupied[cell] = filled;
    });
  });
}

}  // namespace voronerf
