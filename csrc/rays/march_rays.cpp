// march_rays on the CPU: threads share blocks of rays. Rays are independent, and the running sum of the counts is taken
// in order, so results do not depend on the number of threads.
#include "rays/march_rays.h"

#include <algorithm>
#include <cstdlib>
#include <memory>

#include "common/parallel.h"
#include "rays/march_rays_isa.h"
#include "rays/march_rooms.h"

namespace voronerf {

namespace {

constexpr int64_t kRays = 32;  // rays of a task

// Lowers the distances to the nearest occupied voxel in a row of voxels, `to` [cells], by the distances `from` [cells]
// in a parallel row, `away` voxels away: the Chebyshev distance by way of voxel j of `from` is max(from[j], away).
void spread(const uint8_t* from, uint8_t* to, int64_t cells, uint8_t away) {
  for (int64_t j = 0; j < cells; ++j) to[j] = std::min(to[j], std::max(from[j], away));
}

// Computes the distances in slice i of `size` slices, of `step` voxels each, from the distances in nearby slices.
void spread_around(const uint8_t* from, uint8_t* to, int64_t i, int64_t size, int64_t step) {
  uint8_t* target = to + i * step;
  std::copy_n(from + i * step, step, target);
  for (int64_t other = std::max<int64_t>(0, i - kMarchRoom + 1); other < std::min(size, i + kMarchRoom); ++other) {
    spread(from + other * step, target, step, static_cast<uint8_t>(std::abs(other - i)));
  }
}

}  // namespace

std::unique_ptr<uint8_t[]> march_rooms(const MarchInputs& in, int threads) {
  const int64_t slice = in.y * in.z, cells = in.x * slice;
  if (in.uniforms != nullptr || in.seed != nullptr || in.r * in.s < 4 * cells) return nullptr;
  const std::unique_ptr<uint8_t[]> memory(new uint8_t[cells]);
  std::unique_ptr<uint8_t[]> rooms(new uint8_t[cells]);
  uint8_t *one = memory.get(), *other = rooms.get();
  parallel_for(in.x, 1, threads, [&](int64_t x) {
    uint8_t *from = one + x * slice, *to = other + x * slice;
    for (int64_t i = 0; i < slice; ++i) from[i] = to[i] = in.occupied[x * slice + i] != 0 ? 0 : kMarchRoom;
    for (int64_t row = 0; row < slice; row += in.z) {
      for (int64_t away = 1; away < std::min<int64_t>(kMarchRoom, in.z); ++away) {
        spread(from + row + away, to + row, in.z - away, static_cast<uint8_t>(away));
        spread(from + row, to + row + away, in.z - away, static_cast<uint8_t>(away));
      }
    }
    for (int64_t y = 0; y < in.y; ++y) spread_around(to, from, y, in.y, in.z);
  });
  parallel_for(in.x, 1, threads, [&](int64_t x) { spread_around(one, other, x, in.x, slice); });
  return rooms;
}

void march_rays_count_cpu(const MarchInputs& in, uint32_t* mask, int32_t* offsets, int64_t* total, int64_t capacity,
                          Isa isa, int threads) {
  const std::unique_ptr<uint8_t[]> rooms = march_rooms(in, threads);
  parallel_blocks(in.r, kRays, threads, [&](int64_t begin, int64_t end) {
    VN_FOR_ISA(isa, march_count(in, rooms.get(), mask, offsets + 1, begin, end))
  });
  *total = 0;
  offsets[0] = 0;
  for (int64_t i = 1; i <= in.r; ++i) {
    *total = std::min(*total + offsets[i], capacity);
    offsets[i] = static_cast<int32_t>(*total);
  }
}

void march_rays_fill_cpu(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, RowCount rows,
                         int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop, Isa isa,
                         int threads) {
  parallel_blocks(in.r, kRays, threads, [&](int64_t begin, int64_t end) {
    VN_FOR_ISA(isa, march_fill(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end))
  });
  std::fill(ray_index + offsets[in.r], ray_index + rows, 0);
  std::fill(depths + offsets[in.r], depths + rows, 0.0f);
  std::fill(deltas + offsets[in.r], deltas + rows, 0.0f);
  std::fill(positions + 3 * int64_t{offsets[in.r]}, positions + 3 * rows, 0.0f);
}

}  // namespace voronerf
