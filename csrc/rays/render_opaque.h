// Renders the rays of an image, from the march through the occupancy grid to the colour: r rays, k cells, m centres in
// all diagrams. The formulas are in voronerf/ops/render_opaque.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "network/program.h"
#include "rays/march_rays.h"

namespace voronerf {

// The diagrams that assign positions to cells: as in nearest_centre.h, or with `child` as in locate_cell.h. If
// `centres` is null there is only one cell.
struct SeeCells {
  const float* centres;
  const int32_t *child_offsets, *child;
  const int32_t* centre_index;  // an index of a flat diagram's centres (centre_index.h), or null
  int64_t m;
  int depth;
};

struct SeeOptions {
  float opaque;             // a ray ends after a wave that leaves at most this light
  int64_t wave;             // samples of a ray in a wave, which is evaluated at once
  const float* background;  // [r,3], or [3], or null for black
  bool background_per_ray;
};

struct SeeOutputs {
  float* colour;                   // [r,3], including the background
  float *opacity, *depth, *light;  // [r]: opacity, 1 for opaque rays; mean depth, far without samples; remaining light
  float* heaviest;                 // [r], depth of the heaviest sample, far without samples; or null
};

// The march must have no uniforms, seed or start. The program has one output with 4 columns, colour and density. Its
// inputs are positions, whose values in `network` are not read, and optionally directions [r,q], one per ray. Returns
// false if a position is not at a leaf after `depth` levels.
bool render_opaque_cpu(const Program& program, const ProgramInputs& network, const MarchInputs& march,
                       const SeeCells& cells, const SeeOptions& options, const SeeOutputs& out, Isa isa, int threads);

}  // namespace voronerf
