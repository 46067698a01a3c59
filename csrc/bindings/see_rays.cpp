#include "rays/see_rays.h"

#include "bindings/bind.h"
#include "bindings/grouped_mlp.h"
#include "bindings/march_rays.h"

namespace voronerf {

VN_STRUCT(SeeCells, centres, child_offsets, child, m, depth);
VN_STRUCT(SeeRule, density_scale, opaque, wave);
VN_STRUCT(SeeOutputs, colour, opacity, depth, light, heaviest);

VN_BINDINGS(module) {
  module.cpu("see_rays", VN_CPU(see_rays_cpu));
}

}  // namespace voronerf
