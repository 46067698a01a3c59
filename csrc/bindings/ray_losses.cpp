#include "rays/ray_losses.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(SparseDepthInputs, depths, deltas, weights, offsets, distances, nearby, factor, s, r, m);
VN_STRUCT(SmoothDepthInputs, depths, weights, offsets, far, factor, edge, triples, r, m);
VN_STRUCT(SurfaceInputs, depths, deltas, weights, offsets, near, far, distortion, orientation, hidden, r, m);

VN_BINDINGS(module) {
  module.cpu("sparse_depth_loss", VN_CPU(sparse_depth_loss_cpu));
  module.cpu("smooth_depth_loss", VN_CPU(smooth_depth_loss_cpu));
  module.cpu("surface_loss", VN_CPU(surface_loss_cpu));
}

}  // namespace voronerf
