// Inverse-CDF sampling on CUDA, one warp per ray. The running mass of a ray's bins, float64 as on the CPU, goes to the
// workspace [r,s]; then every lane finds the bins of its targets by bisection. Uniforms may have any order: the index
// of a depth in the result is the rank of its uniform. A lane counts ranks by walking over the ray's uniforms (count^2
// / 32 steps, in cache). This sort is stable and needs no scratch memory.
#include "common/cuda_wrappers.h"
#include "rays/ray_warp.h"
#include "rays/resample.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / 32;

// Returns the mass of a bin, 0 for a weight that is not finite or is negative.
__device__ double mass_of(float weight) {
  return weight > 0.0f && weight <= 3.402823466e38f ? static_cast<double>(weight) : 0.0;
}

// Returns whether a uniform sorts before another: by value, NaN last.
__device__ bool is_before(float a, float b) { return a < b || (b != b && a == a); }

__global__ void __launch_bounds__(kThreads)
    resample_kernel(const float* __restrict__ weights, const float* __restrict__ edges,
                    const float* __restrict__ uniforms, float* __restrict__ depths, double* workspace, int64_t r,
                    int64_t s, int64_t count) {
  const int lane = threadIdx.x % 32;
  const int64_t ray = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (ray >= r) return;  // the same for the whole warp
  const float* weight = weights + ray * s;
  double* upper = workspace + ray * s;

  double total = 0.0;
  int64_t last = -1;  // the last bin with mass
  for (int64_t start = 0; start < s; start += 32) {
    const int64_t i = start + lane;
    const double mass = i < s ? mass_of(weight[i]) : 0.0;
    const double running = running_sum(mass, lane);
    if (i < s) upper[i] = total + running;
    const unsigned massive = __ballot_sync(kAllLanes, mass > 0.0);
    if (massive != 0u) last = start + 31 - __clz(static_cast<int>(massive));
    total += __shfl_sync(kAllLanes, running, 31);
  }
  const bool even = last < 0;
  if (even) {
    total = static_cast<double>(s);
    last = s - 1;
  }
  __syncwarp();

  for (int64_t j = lane; j < count; j += 32) {
    const float uniform = uniforms == nullptr ? 0.0f : uniforms[ray * count + j];
    double u = (static_cast<double>(j) + 0.5) / static_cast<double>(count);
    int64_t place = j;
    if (uniforms != nullptr) {
      u = uniform < 0.0f ? 0.0 : uniform > 1.0f ? 1.0 : static_cast<double>(uniform);
      place = 0;
      for (int64_t i = 0; i < count; ++i) {
        const float other = uniforms[ray * count + i];
        place += is_before(other, uniform) || (i < j && !is_before(uniform, other)) ? 1 : 0;
      }
    }
    const double target = u * total;
    // Find the first bin whose end lies beyond the target. On the edge of two bins this is the later bin, so a bin
    // without mass is never drawn. The last bin with mass takes targets that round to the end.
    int64_t low = 0, high = last;
    while (low < high) {
      const int64_t middle = (low + high) / 2;
      const double end = even ? static_cast<double>(middle + 1) : upper[middle];
      if (end > target) {
        high = middle;
      } else {
        low = middle + 1;
      }
    }
    // A NaN target gets the last bin, with a NaN depth.
    const double mass = even ? 1.0 : mass_of(weight[low]);
    const double lower = even ? static_cast<double>(low) : (low == 0 ? 0.0 : upper[low - 1]);
    double inside = (target - lower) / mass;
    inside = inside < 0.0 ? 0.0 : inside > 1.0 ? 1.0 : inside;
    const double near = edges[ray * (s + 1) + low], far = edges[ray * (s + 1) + low + 1];
    const double depth = near + inside * (far - near);
    depths[ray * count + place] = static_cast<float>(depth > far ? far : depth);
  }
}

}  // namespace

void resample_cuda(const float* weights, const float* edges, const float* uniforms, float* depths, double* workspace,
                   int64_t r, int64_t s, int64_t count, void* stream) {
  if (r == 0) return;
  VN_LAUNCH(resample_kernel, static_cast<unsigned>(ceil_div<int64_t>(r, kWarps)), kThreads, 0, stream, weights, edges,
            uniforms, depths, workspace, r, s, count);
}

}  // namespace voronerf
