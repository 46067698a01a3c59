#include "rays/observe_occupancy.h"

#include "bindings/march_rays.h"

namespace voronerf {

VN_STRUCT(ObservedSamples, positions, sigma, deltas, weights, box, fixed, space, x, y, z, m, decay, threshold, hidden);

VN_BINDINGS(module) {
  module.cpu("observe_occupancy", VN_CPU(observe_occupancy_cpu));
  module.cuda("observe_occupancy", VN_CUDA(observe_occupancy_cuda));
}

}  // namespace voronerf
