// Rays that pass through the cells of several ranks: selects a rank's own samples, splits them into runs, and composes
// rays from the partial sums of runs (render_loss.h). Runs are defined in voronerf/ops/ray_runs/__init__.py.
#pragma once

#include <cstdint>

namespace voronerf {

// The samples in the order of their rays, near to far; some belong to other ranks.
struct KnownSamples {
  const float* positions;      // [n,3]
  const int32_t* ray_index;    // [n]
  const float* depths;         // [n]
  const float* deltas;         // [n]
  const int32_t* cells;        // [n]
  const int32_t* local_cells;  // [k], the number of each cell among the rank's own cells, or -1
  int64_t n;
  bool curved;  // rays are curved by a contraction
};

// The rank's own samples. Each array has space for n samples.
struct OwnSamples {
  float* positions;
  int32_t* ray_index;
  float* depths;
  float* deltas;
  int32_t* cells;    // numbers among the rank's own cells
  int32_t* offsets;  // [n+1], the start of each run, then the end of the last run
};

// Copies the rank's own samples to `out`; returns the number of their runs.
int64_t own_samples_cpu(const KnownSamples& in, const OwnSamples& out, int threads);

struct RunsOfRays {
  const float* sums;        // [q,6], the runs' partial sums in any order
  const float* target;      // [r,3], the colours of rays `first` to `first + r`
  const float* background;  // [r,3], or [3], or null
  bool background_per_ray;
  int64_t q, first, r;
  int64_t rays;  // the number of rays of all ranks
  float robust;  // as in RenderLossInputs
};

// Writes to `answers` [q,6] the values that each run needs from its whole ray (render_loss.h). Returns the part of the
// loss due to rays `first` to `first + r`. Throws std::invalid_argument if a run belongs to another ray.
float compose_runs_cpu(const RunsOfRays& in, float* answers, int threads);

}  // namespace voronerf
