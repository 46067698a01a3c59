#include "rays/first_solid.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(SolidsOnRays, origins, directions, r, one_origin, one_direction, kinds, centres, turns, measures, m);

VN_BINDINGS(module) {
  module.cpu("first_solid", VN_CPU(first_solid_cpu));
}

}  // namespace voronerf
