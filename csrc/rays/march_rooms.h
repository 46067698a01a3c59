// Distances to occupied cells, which let rays leap over empty cells; for march_rays and render_opaque on the CPU.
#pragma once

#include <memory>

#include "rays/march_rays.h"

namespace voronerf {

// Returns the `room` of march_count (march_rays_isa.h), or null if rays shall not leap over empty cells. Visiting all
// cells pays if there are many more strata, as for a whole image; a training step has too few strata.
std::unique_ptr<uint8_t[]> march_rooms(const MarchInputs& in, int threads);

}  // namespace voronerf
