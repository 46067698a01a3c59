#include "geometry/draw_cell.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("draw_cell", VN_CPU(draw_cell_cpu));
  module.cpu("draw_cell_places", VN_CPU(draw_cell_places));
  module.cpu("draw_cell_sums", VN_CPU(draw_cell_sums));
  module.cuda("draw_cell", VN_CUDA(draw_cell_cuda));
}

}  // namespace voronerf
