#include "rays/scale_gradient.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("scale_gradient", VN_CPU(scale_gradient_cpu));
  module.cuda("scale_gradient", VN_CUDA(scale_gradient_cuda));
}

}  // namespace voronerf
