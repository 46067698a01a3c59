// How far away occupied cells are, so that rays leap over empty ones; for march_rays and render_opaque on the CPU.
#pragma once

#include <memory>

#include "rays/march_rays.h"

namespace voronerf {

// What march_count (march_rays_isa.h) takes as `room`; null where rays do not leap over empty cells. To look at all
// cells pays where strata are many more, as in a picture of a photograph; in a step they are not.
std::unique_ptr<uint8_t[]> march_rooms(const MarchInputs& in, int threads);

}  // namespace voronerf
