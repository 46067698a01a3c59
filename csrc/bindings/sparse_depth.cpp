#include "rays/sparse_depth.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(SparseDepth, density, depths, deltas, weights, offsets, distances, nearby, factor, density_scale, activated,
          s, r, m);

VN_BINDINGS(module) { module.cpu("sparse_depth_gradient", VN_CPU(sparse_depth_gradient_cpu)); }

}  // namespace voronerf
