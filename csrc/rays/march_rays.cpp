// Blocks of rays over threads; each ray depends on itself alone, and the running sum of the counts is taken in order,
// so results do not depend on the number of threads.
#include "rays/march_rays.h"

#include <algorithm>

#include "common/common.h"
#include "rays/march_rays_isa.h"

namespace voronerf {

namespace {

constexpr int64_t kRays = 64;  // of a task

void count_block(Isa isa, const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, march_count(in, mask, counts, begin, end))
}

void fill_block(Isa isa, const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                float* depths, float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, march_fill(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end))
}

template <typename Run>
void for_each_block(int64_t r, int threads, const Run& run) {
  const int64_t blocks = ceil_div(r, kRays);
#pragma omp parallel for schedule(dynamic) num_threads(threads) if (threads > 1 && blocks > 1)
  for (int64_t b = 0; b < blocks; ++b) run(b * kRays, std::min(r, (b + 1) * kRays));
}

}  // namespace

void march_rays_count_cpu(const MarchInputs& in, uint32_t* mask, int32_t* offsets, int64_t capacity, Isa isa,
                          int threads) {
  for_each_block(in.r, threads,
                 [&](int64_t begin, int64_t end) { count_block(isa, in, mask, offsets + 1, begin, end); });
  int64_t total = 0;
  offsets[0] = 0;
  for (int64_t i = 1; i <= in.r; ++i) {
    total = std::min(total + offsets[i], capacity);
    offsets[i] = static_cast<int32_t>(total);
  }
}

void march_rays_fill_cpu(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int64_t rows,
                         int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop, Isa isa,
                         int threads) {
  for_each_block(in.r, threads, [&](int64_t begin, int64_t end) {
    fill_block(isa, in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  });
  std::fill(ray_index + offsets[in.r], ray_index + rows, 0);
  std::fill(depths + offsets[in.r], depths + rows, 0.0f);
  std::fill(deltas + offsets[in.r], deltas + rows, 0.0f);
  std::fill(positions + 3 * int64_t{offsets[in.r]}, positions + 3 * rows, 0.0f);
}

}  // namespace voronerf
