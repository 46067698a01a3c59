// draw_pixels on the CPU: threads share blocks of pixels. The pixel of draw i is a hash of the seed and of i,
// so it does not depend on the number of threads.
#include "rays/draw_pixels.h"

#include <algorithm>

#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int64_t kPixels = 64;  // pixels of a task

}  // namespace

void draw_pixels_cpu(const DrawPixelsInputs& in, int64_t* pixels, float* uniforms, float* distances, int threads) {
  parallel_blocks(in.b, kPixels, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const uint32_t key = hash_key(*in.seed, i);
      if (i < in.known_count) {
        const int64_t place = draw_place(key, in.p);
        pixels[i] = in.known_pixels[place];
        distances[i] = in.distances[place];
      } else {
        pixels[i] = draw_place(key, in.below);
      }
      for (int channel = 0; channel < 3; ++channel) uniforms[3 * i + channel] = hashed(key, 2 + channel);
    }
    if (in.ends == nullptr) return;
    int64_t run[kPixels];
    const int64_t first = std::min(std::max<int64_t>(begin, in.known_count), end);
    for (int64_t i = first; i < end; ++i) {
      run[i - begin] = first_run(in, pixels[i]);
      __builtin_prefetch(in.ends + run[i - begin]);
      __builtin_prefetch(in.shift + run[i - begin]);
    }
    for (int64_t i = first; i < end; ++i) pixels[i] += in.shift[run_of(in, run[i - begin], pixels[i])];
  });
}

}  // namespace voronerf
