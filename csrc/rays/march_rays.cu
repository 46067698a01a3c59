// march_rays on CUDA in three launches: one warp per ray finds the kept strata, one block sums the counts, and one warp
// per ray writes the samples. Each lane has one stratum, so that a warp's ballot is a word of the mask, and the writes
// of a ray's samples are coalesced. Numbers of strata are small: 64 strata take two steps.
//
// One block sums over the rays, 1,024 at a time: a training step has some thousands of rays. An image rendered at once
// has a million rays, and its thousand rounds are short compared with the milliseconds of the networks.
#include <algorithm>

#include "common/cuda_wrappers.h"
#include "rays/march_rays_math.h"
#include "rays/ray_warp.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / 32;
constexpr int kScanThreads = 1024;
static_assert(kMarchWord == 32, "a word of the mask is the votes of a warp");

__device__ __forceinline__ uint32_t lanes_below(int lane) { return (1u << lane) - 1u; }

VN_HD float sample_of(const MarchInputs& in, const MarchRay& ray, uint32_t key, int64_t i, int64_t stratum,
                      float* point, float& length) {
  const float at = march_by_spacing(in.spacing, [&](auto spacing) {
    using Spacing = decltype(spacing);
    const float first = march_edge<Spacing>(ray, stratum), last = march_edge<Spacing>(ray, stratum + 1);
    length = last - first;
    return march_sample<Spacing>(ray, stratum, march_inside(in, key, i, stratum), first, last);
  });
  march_point(in, march_where(in), in.origins + 3 * i, in.directions + 3 * i, at, point);
  return at;
}

__global__ void __launch_bounds__(kThreads)
    march_count_kernel(MarchInputs in, uint32_t* __restrict__ mask, int32_t* __restrict__ counts) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (i >= in.r) return;  // the same for the whole warp
  const int lane = threadIdx.x % 32;
  const int64_t words = march_words(in.s);
  const MarchRay ray = march_ray(in, i);
  const int64_t start = in.start == nullptr || in.start[i] < 0 ? 0 : in.start[i];
  const uint32_t key = march_key(in, i);
  float scale[3];
  march_scale(in, scale);
  int64_t samples = 0;
  for (int64_t w = 0; w < words; ++w) {
    uint32_t word = 0;
    if (ray.far > ray.near && (w + 1) * kMarchWord > start && samples < in.max_samples) {
      const int64_t stratum = w * kMarchWord + lane;
      bool kept = false;
      if (stratum >= start && stratum < in.s) {
        float point[3], length;
        sample_of(in, ray, key, i, stratum, point, length);
        const int32_t cell = march_cell(in, scale, point);
        kept = cell >= 0 && in.occupied[cell] != 0;
      }
      word = __ballot_sync(kAllLanes, kept);
      // Drop the last samples beyond the maximum.
      word = __ballot_sync(kAllLanes, kept && samples + __popc(word & lanes_below(lane)) < in.max_samples);
      samples += __popc(word);
    }
    if (lane == 0) mask[i * words + w] = word;
  }
  if (lane == 0) counts[i] = static_cast<int32_t>(samples);
}

// Replaces the counts in offsets[1:] by their running sums, at most `capacity`.
__global__ void __launch_bounds__(kScanThreads) march_scan_kernel(int32_t* offsets, int64_t r, int64_t capacity) {
  VN_SHARED(sums, int32_t[32]);
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  int32_t before = 0;  // r * s < 2^31
  if (threadIdx.x == 0) offsets[0] = 0;
  for (int64_t first = 1; first <= r; first += kScanThreads) {
    const int64_t i = first + threadIdx.x;
    const int32_t sum = running_sum(i <= r ? offsets[i] : 0, lane);
    if (lane == 31) sums[warp] = sum;
    __syncthreads();
    const int32_t of_warps = running_sum(sums[lane], lane);
    const int32_t lower = __shfl_sync(kAllLanes, of_warps, warp == 0 ? 0 : warp - 1);
    const int32_t total = before + (warp == 0 ? 0 : lower) + sum;
    if (i <= r) offsets[i] = static_cast<int32_t>(total < capacity ? total : capacity);
    before += __shfl_sync(kAllLanes, of_warps, 31);
    __syncthreads();  // sums are free for the next round
  }
}

__global__ void __launch_bounds__(kThreads)
    march_fill_kernel(MarchInputs in, const uint32_t* __restrict__ mask, const int32_t* __restrict__ offsets,
                      int64_t rows, int32_t* __restrict__ ray_index, float* __restrict__ depths,
                      float* __restrict__ deltas, float* __restrict__ positions, int32_t* __restrict__ stop) {
  const int64_t threads = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t row = offsets[in.r] + static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; row < rows;
       row += threads) {
    ray_index[row] = 0;
    depths[row] = deltas[row] = 0.0f;
    for (int axis = 0; axis < 3; ++axis) positions[3 * row + axis] = 0.0f;
  }
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (i >= in.r) return;
  const int lane = threadIdx.x % 32;
  const int64_t words = march_words(in.s), row = offsets[i], room = offsets[i + 1] - row;
  const MarchRay ray = march_ray(in, i);
  const uint32_t key = march_key(in, i);
  int64_t rank_of_word = 0;
  for (int64_t w = 0; w < words && rank_of_word <= room; ++w) {
    const uint32_t word = mask[i * words + w];
    const int64_t stratum = w * kMarchWord + lane, rank = rank_of_word + __popc(word & lanes_below(lane));
    rank_of_word += __popc(word);
    if ((word >> lane & 1u) == 0 || rank > room) continue;
    if (rank == room) {  // the first sample that does not fit
      stop[i] = static_cast<int32_t>(stratum);
      continue;
    }
    float point[3], length;
    depths[row + rank] = sample_of(in, ray, key, i, stratum, point, length);
    deltas[row + rank] = length;
    ray_index[row + rank] = static_cast<int32_t>(i);
    for (int axis = 0; axis < 3; ++axis) positions[3 * (row + rank) + axis] = point[axis];
    // If a ray has its maximum of samples, its next march starts at the stratum after the last sample.
    if (rank + 1 == in.max_samples) stop[i] = static_cast<int32_t>(stratum + 1);
  }
  if (lane == 0 && rank_of_word <= room && rank_of_word < in.max_samples) stop[i] = static_cast<int32_t>(in.s);
}

}  // namespace

void march_rays_count_cuda(const MarchInputs& in, uint32_t* mask, int32_t* offsets, int64_t capacity, void* stream) {
  if (in.r > 0) {
    const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(in.r, kWarps));
    VN_LAUNCH(march_count_kernel, blocks, kThreads, 0, stream, in, mask, offsets + 1);
  }
  VN_LAUNCH(march_scan_kernel, 1, kScanThreads, 0, stream, offsets, in.r, capacity);
}

void march_rays_fill_cuda(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int64_t rows,
                          int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop,
                          void* stream) {
  if (in.r == 0 && rows == 0) return;
  const unsigned blocks = static_cast<unsigned>(std::max<int64_t>(ceil_div<int64_t>(in.r, kWarps), 1));
  VN_LAUNCH(march_fill_kernel, blocks, kThreads, 0, stream, in, mask, offsets, rows, ray_index, depths, deltas,
            positions, stop);
}

}  // namespace voronerf
