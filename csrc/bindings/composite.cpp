#include "rays/composite.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(CompositeInputs, sigma, rgb, depths, deltas, offsets, background, background_per_ray, r, s, m, c);
VN_STRUCT(CompositeOutputs, colour, opacity, depth, weights);
VN_STRUCT(CompositeGradients, colour, opacity, depth, weights, sigma, rgb, depths, deltas, background, left);

VN_BINDINGS(module) {
  module.cpu("composite", VN_CPU(composite_cpu));
  module.cpu("composite_backward", VN_CPU(composite_backward_cpu));
  module.cuda("composite", VN_CUDA(composite_cuda));
  module.cuda("composite_backward", VN_CUDA(composite_backward_cuda));
}

}  // namespace voronerf
