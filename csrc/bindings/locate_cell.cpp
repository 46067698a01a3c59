#include "geometry/locate_cell.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("locate_cell", VN_CPU(locate_cell_cpu<float>));
  module.cpu("locate_cell", VN_CPU(locate_cell_cpu<double>));
  module.cuda("locate_cell", VN_CUDA(locate_cell_cuda<float>));
  module.cuda("locate_cell", VN_CUDA(locate_cell_cuda<double>));
  module.cpu("locate_cell_workspace", VN_CPU(locate_cell_workspace));
  module.plain("locate_cell_fault", VN_CPU(locate_cell_fault));
}

}  // namespace voronerf
