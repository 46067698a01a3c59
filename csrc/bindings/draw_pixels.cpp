#include "rays/draw_pixels.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(DrawPixelsInputs, seed, ends, shift, first, n, places, bits, below, b, known_pixels, distances, p,
          known_count);

VN_BINDINGS(module) {
  module.cpu("draw_pixels", VN_CPU(draw_pixels_cpu));
  module.cuda("draw_pixels", VN_CUDA(draw_pixels_cuda));
}

}  // namespace voronerf
