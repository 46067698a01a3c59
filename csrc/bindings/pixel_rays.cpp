#include "rays/pixel_rays.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(PixelRaysInputs, poses, intrinsics, lens, tables, images, pixels, box, background, background_per_ray, c, h,
          w, channels, b, l, near, far);
VN_STRUCT(PixelRaysOutputs, origins, directions, near, far, colour);

VN_BINDINGS(module) {
  module.cpu("pixel_rays", VN_CPU(pixel_rays_cpu));
  module.cuda("pixel_rays", VN_CUDA(pixel_rays_cuda));
}

}  // namespace voronerf
