// Rays through pixels on CUDA, one thread per ray, with the CPU's arithmetic.
#include "common/cuda_wrappers.h"
#include "rays/pixel_rays_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads) pixel_rays_kernel(PixelRaysInputs in, PixelRaysOutputs out) {
  const int64_t ray = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (ray < in.b) pixel_ray(in, out, ray);
}

}  // namespace

void pixel_rays_cuda(const PixelRaysInputs& in, const PixelRaysOutputs& out, void* stream) {
  if (in.b == 0 || in.c * in.h * in.w == 0) return;
  VN_LAUNCH(pixel_rays_kernel, static_cast<unsigned>(ceil_div<int64_t>(in.b, kThreads)), kThreads, 0, stream, in, out);
}

}  // namespace voronerf
