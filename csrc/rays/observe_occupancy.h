// Updates an occupancy grid from rendered samples, in place: x, y, z voxels, m samples. The formula is in
// voronerf/ops/observe_occupancy.
#pragma once

#include <cstdint>

#include "common/row_count.h"
#include "rays/march_rays.h"

namespace voronerf {

struct ObservedSamples {
  const float *positions, *sigma;  // [m,3], [m]
  const float *deltas, *weights;   // [m], or both null if all light reaches every sample
  const float* box;                // [2,3]
  const uint8_t* fixed;            // [x,y,z], nonzero for voxels that must not change; or null
  MarchSpace space;                // the space of positions, box and grid; sigma and deltas are in world space
  int64_t x, y, z;
  RowCount m;
  float decay, threshold, hidden;
};

// density, occupied: [x,y,z]. cells (voxels), before: [m], workspace.
void observe_occupancy_cpu(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                           int threads);
void observe_occupancy_cuda(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                            void* stream);

}  // namespace voronerf
