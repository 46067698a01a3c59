// Blocks of samples over threads.
#include "rays/scale_gradient.h"

#include <algorithm>

#include "common/parallel.h"

namespace voronerf {

void scale_gradient_cpu(const float* depths, float full, RowCount m, int64_t c, float* gradient, int threads) {
  constexpr int64_t kSamples = 1024;  // of a task
  parallel_for((m + kSamples - 1) / kSamples, 1, threads, [&](int64_t block) {
    const int64_t end = std::min<int64_t>(m, (block + 1) * kSamples);
    for (int64_t i = block * kSamples; i < end; ++i) {
      const float share = gradient_share(depths[i], full);
      for (int64_t j = 0; j < c; ++j) gradient[i * c + j] *= share;
    }
  });
}

}  // namespace voronerf
