#include "rays/draw_points.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("draw_points", VN_CPU(draw_points_cpu));
  module.cuda("draw_points", VN_CUDA(draw_points_cuda));
}

}  // namespace voronerf
