#include "rays/resample.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("resample", VN_CPU(resample_cpu));
  module.cuda("resample", VN_CUDA(resample_cuda));
}

}  // namespace voronerf
