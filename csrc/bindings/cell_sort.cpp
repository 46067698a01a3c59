#include "geometry/cell_sort.h"

#include "bindings/bind.h"

namespace voronerf {

VN_NAMES(CellSortWay, "automatic", "counting", "radix");

VN_BINDINGS(module) {
  module.cpu("cell_sort", VN_CPU(cell_sort_cpu));
  module.cpu("one_cell", VN_CPU(one_cell_cpu));
  module.cuda("cell_sort", VN_CUDA(cell_sort_cuda));
  module.cuda("cell_sort_workspace", VN_CUDA(cell_sort_workspace_cuda));
}

}  // namespace voronerf
