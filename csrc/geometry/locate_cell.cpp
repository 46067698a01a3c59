// The nested query on the CPU: blocks of points go down the tree (tree_descent.h), and the vectorised kernel of
// nearest_centre handles each group.
#include "geometry/locate_cell.h"

#include "geometry/nearest_centre.h"
#include "geometry/tree_descent.h"

namespace voronerf {

const char* locate_cell_fault(const int32_t* child_offsets, const int32_t* child, int64_t g, int64_t m) {
  if (child_offsets[0] != 0 || child_offsets[g] != m) return "child_offsets must go from 0 to the number of centres";
  for (int64_t j = 0; j < g; ++j) {
    if (child_offsets[j] >= child_offsets[j + 1]) return "child_offsets must increase: every diagram has a centre";
  }
  for (int64_t c = 0; c < m; ++c) {
    if (child[c] >= g) return "child must name a diagram (below the number of diagrams) or a leaf (negative)";
  }
  return nullptr;
}

int64_t locate_cell_workspace(int64_t m, int threads) { return threads * descent_stride(m); }

template <typename T>
bool locate_cell_cpu(const T* points, const T* centres, const int32_t* child_offsets, const int32_t* child,
                     int32_t* leaves, int32_t* workspace, RowCount n, int64_t m, int depth, Isa isa, int threads) {
  const auto find = [&](const T* at, const int32_t*, int32_t count, int32_t first, int32_t size, int, int32_t* nearest,
                        int64_t, int) {
    nearest_centre_serial(at, centres + 3 * static_cast<int64_t>(first), nearest, count, size, isa);
  };
  return descend({child_offsets, child, depth}, points, leaves, workspace, n, m, threads, find);
}

template bool locate_cell_cpu(const float*, const float*, const int32_t*, const int32_t*, int32_t*, int32_t*, RowCount,
                              int64_t, int, Isa, int);
template bool locate_cell_cpu(const double*, const double*, const int32_t*, const int32_t*, int32_t*, int32_t*,
                              RowCount, int64_t, int, Isa, int);

}  // namespace voronerf
