// Drawing a leaf by its distances on CUDA (draw_cell.h): a thread a point goes down the tree, and at each diagram three
// times over the centres: for the nearest, for the sum of the masses, and for the first centre up to which they sum to
// enough, in the same order and with the same roundings. Neighbouring samples of a ray share their diagrams, so that
// the centres come from the first-level cache; nothing but a few numbers is kept, whatever the number of centres.
#include "common/cuda_wrappers.h"
#include "geometry/draw_cell.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr float kLeast = 5.9604645e-8f;  // 2^-24: 1 - u of the largest u below 1

struct Diagram {
  const float *centres, *weights;
  float heaviest;
  int32_t k;
};

__device__ float squared_distance(const float* point, const Diagram& in, int32_t j) {
  const float dx = point[0] - in.centres[3 * j], dy = point[1] - in.centres[3 * j + 1];
  const float dz = point[2] - in.centres[3 * j + 2];
  const float squared = fmaf(dz, dz, fmaf(dy, dy, dx * dx));
  return in.weights == nullptr ? squared : squared + (in.heaviest - in.weights[j]);
}

// 0 for NaN, as of a point that is not finite. 1 at most, which the device's exponential may exceed by
// its rounding.
__device__ float mass_of(float nearest, float squared, float temperature) {
  const float mass = expf((nearest - sqrtf(squared)) / temperature);
  return mass >= 0.0f ? fminf(mass, 1.0f) : 0.0f;
}

__device__ int32_t drawn_in(const float* point, const float* centres, const float* weights, int32_t k,
                            float temperature, float uniform) {
  Diagram in{centres, weights, -INFINITY, k};
  for (int32_t j = 0; weights != nullptr && j < k; ++j) in.heaviest = fmaxf(in.heaviest, weights[j]);
  float nearest = INFINITY;
  for (int32_t j = 0; j < k; ++j) nearest = fminf(nearest, squared_distance(point, in, j));
  nearest = sqrtf(nearest);
  float total = 0.0f;
  for (int32_t j = 0; j < k; ++j) total += mass_of(nearest, squared_distance(point, in, j), temperature);
  if (!(total > 0.0f)) return 0;
  // The minimum of 1 and NaN is 1: NaN counts as 0.
  const float wanted = fmaxf(fminf(1.0f - uniform, 1.0f), kLeast) * total;
  float sum = 0.0f;
  for (int32_t j = 0; j < k; ++j) {
    sum += mass_of(nearest, squared_distance(point, in, j), temperature);
    if (sum >= wanted) return j;
  }
  return k - 1;
}

__global__ void __launch_bounds__(kThreads)
    draw_cell_kernel(const float* __restrict__ points, const float* __restrict__ centres,
                     const float* __restrict__ weights, const int32_t* __restrict__ child_offsets,
                     const int32_t* __restrict__ child, const float* __restrict__ uniforms,
                     int32_t* __restrict__ leaves, int64_t n, int64_t m, int64_t g, int depth, float temperature) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= n) return;
  int32_t state = 0;  // the diagram the point is in, or (negative) the leaf it has reached
  for (int d = 0; d < depth && state >= 0; ++d) {
    if (state >= g) break;
    const int32_t first = child_offsets[state], end = child_offsets[state + 1];
    if (first < 0 || end <= first || end > m) break;
    const float* own = weights == nullptr ? nullptr : weights + first;
    const int32_t drawn = drawn_in(points + 3 * i, centres + 3 * static_cast<int64_t>(first), own, end - first,
                                   temperature, uniforms[i * depth + d]);
    state = child[first + drawn];
  }
  leaves[i] = ~state;  // -state - 1, which could overflow; negative where the walk has reached no leaf
}

}  // namespace

void draw_cell_cuda(const float* points, const float* centres, const float* weights, const int32_t* child_offsets,
                    const int32_t* child, const float* uniforms, int32_t* leaves, int64_t n, int64_t m, int64_t g,
                    int depth, double temperature, void* stream) {
  if (n == 0) return;
  // Neither 0 nor infinite in float32: the nearest centre's mass is 1 at any temperature.
  const float warm = static_cast<float>(temperature < 1e-37 ? 1e-37 : temperature > 3e38 ? 3e38 : temperature);
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(n, kThreads));
  VN_LAUNCH(draw_cell_kernel, blocks, kThreads, 0, stream, points, centres, weights, child_offsets, child, uniforms,
            leaves, n, m, g, depth, warm);
}

}  // namespace voronerf
