// pixel_rays on the CPU: threads share blocks of rays, and rays are independent. Pixels lie anywhere in the images, so
// a block prefetches all of its pixels before it computes the first ray.
#include "rays/pixel_rays.h"

#include <atomic>

#include "common/parallel.h"
#include "rays/pixel_rays_math.h"

namespace voronerf {

namespace {

constexpr int64_t kRays = 32;  // rays of a task

}  // namespace

bool pixel_rays_cpu(const PixelRaysInputs& in, const PixelRaysOutputs& out, int threads) {
  const int64_t all = in.c * in.h * in.w;
  std::atomic<bool> fine{true};
  parallel_blocks(in.b, kRays, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      if (in.pixels[i] < 0 || in.pixels[i] >= all) {
        fine.store(false, std::memory_order_relaxed);
        return;
      }
      __builtin_prefetch(in.images + in.channels * in.pixels[i]);
      if (in.tables == nullptr) continue;  // saves a division for each ray
      const int64_t pixels_per_image = in.h * in.w, camera = in.pixels[i] / pixels_per_image;
      __builtin_prefetch(table_entry(in, camera, in.pixels[i] - camera * pixels_per_image));
    }
    for (int64_t i = begin; i < end; ++i) pixel_ray(in, out, i);
  });
  return fine.load(std::memory_order_relaxed);
}

}  // namespace voronerf
