#include "rays/unseen_rays.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(UnseenRays, seed, move, tilt, triples, r);

VN_BINDINGS(module) { module.cpu("unseen_rays", VN_CPU(unseen_rays_cpu)); }

}  // namespace voronerf
