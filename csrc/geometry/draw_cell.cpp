// Drawing cells on the CPU: blocks of points go down the tree (tree_descent.h), each group with the numbers drawn for
// its points at this level. A point's cell depends on that point and its numbers alone, so the result does not depend
// on the number of threads.
#include "geometry/draw_cell.h"

#include <algorithm>

#include "geometry/tree_descent.h"

namespace voronerf {

int64_t draw_cell_places(int64_t m, int threads) {
  return threads * descent_stride(m);
}

int64_t draw_cell_sums(int64_t m, int threads) {
  return threads * m * kDrawLanes;
}

bool draw_cell_cpu(const float* points, const float* centres, const float* weights, const int32_t* child_offsets,
                   const int32_t* child, const float* uniforms, int32_t* leaves, int32_t* places, float* sums,
                   int64_t n, int64_t m, int depth, double temperature, Isa isa, int threads) {
  // Zero distance over any temperature is 0: neither of the two may be infinite.
  const double largest = 3e38;
  const float warm = static_cast<float>(std::min(temperature, largest));
  const float inverse = static_cast<float>(std::min(1.0 / temperature, largest));
  const auto find = [&](const float* at, const int32_t* rows, int32_t count, int32_t first, int32_t size, int level,
                        int32_t* found, int64_t start, int thread) {
    float drawn[kDescentBlock];
    for (int32_t i = 0; i < count; ++i) drawn[i] = uniforms[(start + rows[i]) * depth + level];
    const float* own = weights == nullptr ? nullptr : weights + first;
    VN_FOR_ISA(isa, draw_cell(at, centres + 3 * static_cast<int64_t>(first), own, drawn, warm, inverse,
                              sums + thread * m * kDrawLanes, found, count, size))
  };
  return descend({child_offsets, child, depth}, points, leaves, places, n, m, threads, find);
}

}  // namespace voronerf
