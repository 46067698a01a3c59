#include "rays/render_loss.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(RenderLossInputs, raw, deltas, offsets, target, background, background_per_ray, density_scale, activated,
          hidden, robust, triples, r, m);
VN_STRUCT(RenderLossOutputs, loss, colour, weights, density, error, gradient);

VN_BINDINGS(module) {
  module.cpu("render_loss", VN_CPU(render_loss_cpu));
  module.cuda("render_loss", VN_CUDA(render_loss_cuda));
}

}  // namespace voronerf
