#include "rays/render_opaque.h"

#include "bindings/bind.h"
#include "bindings/march_rays.h"
#include "bindings/program.h"

namespace voronerf {

VN_STRUCT(SeeCells, centres, child_offsets, child, centre_index, m, depth);
VN_STRUCT(SeeOptions, opaque, wave, background, background_per_ray);
VN_STRUCT(SeeOutputs, colour, opacity, depth, light, heaviest);

VN_BINDINGS(module) { module.cpu("render_opaque", VN_CPU(render_opaque_cpu)); }

}  // namespace voronerf
