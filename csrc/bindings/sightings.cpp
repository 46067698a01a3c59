#include "rays/sightings.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(Sightings, density, depths, deltas, weights, offsets, distances, nearby, s, m);

VN_BINDINGS(module) {
  module.cpu("sighting_gradient", VN_CPU(sighting_gradient_cpu));
}

}  // namespace voronerf
