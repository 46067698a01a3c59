// Rays that pass through the cells of several ranks: which samples are a rank's own, which of them make a run, and rays
// put together from the partial sums of runs (render_loss.h). What a run is, is said in
// voronerf/ops/ray_runs/__init__.py.
#pragma once

#include <cstdint>

namespace voronerf {

// Samples in the order of their rays, near to far, some of other ranks.
struct KnownSamples {
  const float* positions;    // [n,3]
  const int32_t* ray_index;  // [n]
  const float* depths;       // [n]
  const float* deltas;       // [n]
  const int32_t* cells;      // [n]
  const int32_t* own;        // [k], the number of each cell among a rank's own, or -1
  int64_t n;
  bool bent;  // rays are, by a contraction
};

// Room for all of them.
struct OwnSamples {
  float* positions;
  int32_t* ray_index;
  float* depths;
  float* deltas;
  int32_t* cells;    // among the own ones
  int32_t* offsets;  // [n+1], where each run begins, and the end of the last
};

// Keeps own samples; returns how many runs they make.
int64_t own_samples_cpu(const KnownSamples& in, const OwnSamples& out, int threads);

struct RunsOfRays {
  const float* sums;        // [q,6], of any order
  const float* target;      // [r,3], the colours of rays `first` to `first + r`
  const float* background;  // [r,3], or [3], or null
  bool background_per_ray;
  int64_t q, first, r;
  int64_t rays;  // of all ranks
  float robust;  // as of RenderLossInputs
};

// Answers [q,6] to the sums; returns what these rays add to the loss. Throws std::invalid_argument for other rays.
float compose_runs_cpu(const RunsOfRays& in, float* answers, int threads);

}  // namespace voronerf
