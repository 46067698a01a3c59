#include "rays/surface.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(Surface, density, depths, deltas, weights, offsets, near, far, distortion, orientation, hidden, density_scale,
          activated, r, m);

VN_BINDINGS(module) { module.cpu("surface_gradient", VN_CPU(surface_gradient_cpu)); }

}  // namespace voronerf
