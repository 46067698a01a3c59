// The kernels of march_rays, once for each instruction set: rays [begin, end).
#pragma once

#include "rays/march_rays.h"

namespace voronerf {

// The most that `room` says.
constexpr int kMarchRoom = 4;

// Leaves the number of samples of ray i in counts[i]. room: for each cell of the grid, how many cells away along any
// axis an occupied one may be: 0 for its own, kMarchRoom for that or more; or null. For middles alone.
VN_DECLARE_FOR_ISA(void march_count(const MarchInputs& in, const uint8_t* room, uint32_t* mask, int32_t* counts,
                                    int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(void march_fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets,
                                   int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop,
                                   int64_t begin, int64_t end))

}  // namespace voronerf
