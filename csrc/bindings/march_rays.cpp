#include "bindings/march_rays.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("march_rays_count", VN_CPU(march_rays_count_cpu));
  module.cpu("march_rays_fill", VN_CPU(march_rays_fill_cpu));
  module.cuda("march_rays_count", VN_CUDA(march_rays_count_cuda));
  module.cuda("march_rays_fill", VN_CUDA(march_rays_fill_cuda));
}

}  // namespace voronerf
