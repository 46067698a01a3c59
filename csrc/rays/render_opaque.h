// What rays of a picture see, from the walk through the occupancy grid to the colour: r rays, k cells, m centres of all
// diagrams together. What it computes is said in voronerf/ops/render_opaque.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "network/program.h"
#include "rays/march_rays.h"

namespace voronerf {

// In which cell a place lies, as in nearest_centre.h, or with a child in locate_cell.h; without centres in the only
// one.
struct SeeCells {
  const float* centres;
  const int32_t *child_offsets, *child;
  const int32_t* centre_index;  // of a flat diagram's centres (centre_index.h), or null
  int64_t m;
  int depth;
};

struct SeeRule {
  float density_scale;
  bool activated;           // the networks put out colour and density as they are
  float opaque;             // a ray ends behind a wave after which no more light than this is left
  int64_t wave;             // samples of a ray that are evaluated at once
  const float* background;  // [r,3], or [3], or null for black
  bool background_per_ray;
};

struct SeeOutputs {
  float* colour;                   // [r,3], the background included
  float *opacity, *depth, *light;  // [r]: 1 for rays that have ended; mean depth, far without samples; what is left
  float* heaviest;                 // [r], depth of the heaviest sample, far without any; or null
};

// The march has no uniforms, seed or start. The network is a program of one output of 4 columns, whose inputs are
// positions, which are not read, and directions [r,q], one a ray, or none. False if a place is not at a leaf after
// `depth` levels.
bool render_opaque_cpu(const Program& program, const ProgramInputs& network, const MarchInputs& march,
                       const SeeCells& cells, const SeeRule& rule, const SeeOutputs& out, Isa isa, int threads);

}  // namespace voronerf
