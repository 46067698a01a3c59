#include "rays/ray_runs.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(KnownSamples, positions, ray_index, depths, deltas, cells, local_cells, n, curved);
VN_STRUCT(OwnSamples, positions, ray_index, depths, deltas, cells, offsets);
VN_STRUCT(RunsOfRays, sums, target, background, background_per_ray, q, first, r, rays, robust);

VN_BINDINGS(module) {
  module.cpu("own_samples", VN_CPU(own_samples_cpu));
  module.cpu("compose_runs", VN_CPU(compose_runs_cpu));
}

}  // namespace voronerf
