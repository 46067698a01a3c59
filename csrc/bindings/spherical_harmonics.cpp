#include "encoding/spherical_harmonics.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("spherical_harmonics", VN_CPU(spherical_harmonics_cpu));
  module.cpu("spherical_harmonics_backward", VN_CPU(spherical_harmonics_backward_cpu));
  module.cuda("spherical_harmonics", VN_CUDA(spherical_harmonics_cuda));
  module.cuda("spherical_harmonics_backward", VN_CUDA(spherical_harmonics_backward_cuda));
}

}  // namespace voronerf
