// The CPU kernels of march_rays, compiled once per instruction set. Each call handles rays [begin, end).
#pragma once

#include "rays/march_rays.h"

namespace voronerf {

// The largest value in `room`.
constexpr int kMarchRoom = 4;

// Writes the number of samples of ray i to counts[i]. room: for each voxel of the grid, the Chebyshev distance in
// voxels to the nearest occupied voxel, at most kMarchRoom (0 if the voxel itself is occupied); or null. `room` must be
// null unless samples are the middles of strata.
VN_DECLARE_FOR_ISA(void march_count(const MarchInputs& in, const uint8_t* room, uint32_t* mask, int32_t* counts,
                                    int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(void march_fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets,
                                   int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop,
                                   int64_t begin, int64_t end))

}  // namespace voronerf
