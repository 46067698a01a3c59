// Distances to occupied voxels, which let rays leap over empty voxels; for march_rays and render_opaque on the CPU.
#pragma once

#include <memory>

#include "rays/march_rays.h"

namespace voronerf {

// Returns the `room` of march_count (march_rays_isa.h), or null if rays should not leap over empty voxels. The
// computation visits all voxels. It pays if there are many more strata than voxels, as in a whole image, but not in a
// training step.
std::unique_ptr<uint8_t[]> march_rooms(const MarchInputs& in, int threads);

}  // namespace voronerf
