// The structs of march_rays as Python passes them.
#pragma once

#include "bindings/bind.h"
#include "rays/march_rays.h"

namespace voronerf {

VN_NAMES(MarchSpacing, "linear", "disparity");
VN_STRUCT(MarchSpace, sphere, perspective);
VN_STRUCT(MarchInputs, origins, directions, near, far, occupied, box, uniforms, seed, start, r, s, x, y, z, spacing,
          max_samples, space);

}  // namespace voronerf
