// Blocks of rays over threads; each ray depends on itself alone. The pixels lie anywhere in the images, so a block asks
// for all of its own before it computes with the first.
#include "rays/pixel_rays.h"

#include <atomic>

#include "common/parallel.h"
#include "rays/pixel_rays_math.h"

namespace voronerf {

namespace {

constexpr int64_t kRays = 32;  // of a task

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
      if (in.tables == nullptr) continue;  // spares a division for each ray
      const int64_t each = in.h * in.w, camera = in.pixels[i] / each;
      __builtin_prefetch(table_entry(in, camera, in.pixels[i] - camera * each));
    }
    for (int64_t i = begin; i < end; ++i) pixel_ray(in, out, i);
  });
  return fine.load(std::memory_order_relaxed);
}

}  // namespace voronerf
