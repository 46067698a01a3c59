#include "rays/update_occupancy.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("update_occupancy", VN_CPU(update_occupancy_cpu));
  module.cuda("update_occupancy", VN_CUDA(update_occupancy_cuda));
}

}  // namespace voronerf
