#include "rays/smooth_depth.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(SmoothDepth, density, depths, deltas, weights, offsets, far, factor, hidden, edge, density_scale, activated,
          triples, r, m);

VN_BINDINGS(module) { module.cpu("smooth_depth_gradient", VN_CPU(smooth_depth_gradient_cpu)); }

}  // namespace voronerf
