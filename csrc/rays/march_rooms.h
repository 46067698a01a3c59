// How far away occupied cells are, so that rays leap over empty ones; for march_rays and render_opaque on the CPU.
#pragma once

#include "rays/march_rays.h"

namespace voronerf {

// Whether rays leap over empty cells. To look at all cells pays where strata are many more, as in a picture of a
// photograph; in a step they are not.
bool march_leaps(const MarchInputs& in);

// What march_count (march_rays_isa.h) takes as `room`, in `memory` of two grids.
const uint8_t* march_rooms(const MarchInputs& in, uint8_t* memory, int threads);

}  // namespace voronerf
