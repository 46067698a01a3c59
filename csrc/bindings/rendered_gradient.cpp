#include "rays/rendered_gradient.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(RenderedGradient, raw, depths, deltas, weights, offsets, background, background_per_ray, of_colour,
          of_opacity, of_depth, of_weights, of_rgb, of_density, hidden, density_scale, activated, r, m);

VN_BINDINGS(module) { module.cpu("rendered_gradient", VN_CPU(rendered_gradient_cpu)); }

}  // namespace voronerf
