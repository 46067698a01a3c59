#include "rays/keep_heaviest.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(WeighedSamples, points, weights, error, ray_index, m, r, d);
VN_STRUCT(KeptSamples, points, importance, added, b, q);

VN_BINDINGS(module) {
  module.plain("keep_heaviest_workspace", &keep_heaviest_workspace);
  module.cpu("keep_heaviest", VN_CPU(keep_heaviest_cpu));
}

}  // namespace voronerf
