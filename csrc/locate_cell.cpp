// The nested query on the CPU, a block of points at a time: at each level the block's points lie grouped by the diagram
// they are in, every group goes through the vectorised kernel of nearest_centre, and a counting sort by the centre
// found makes the groups of the next level. A point costs the sum of its diagrams' sizes (32 distances for 16 x 16
// cells, not 256), and the block stays in the second-level cache throughout.
#include "locate_cell.h"

#include <algorithm>
#include <atomic>

#include "common.h"
#include "nearest_centre.h"
#include "parallel.h"

namespace voronerf {

namespace {

constexpr int kBlock = 2048;

// Rows begin:end of the block are in this diagram.
struct Group {
  int32_t diagram, begin, end;
};

// The points of a level, their rows in the block, and their groups. Every group has a point, so kBlock groups suffice.
template <typename T>
struct Level {
  T points[3 * kBlock];
  int32_t rows[kBlock];
  Group groups[kBlock];
  int num_groups;
};

template <typename T>
struct Tree {
  const T *centres, *weights;
  float weight_bound;
  const int32_t *child_offsets, *child;
  int depth;
  Isa isa;
};

// One group: leaves are written, the other points appended to `next`. `place` holds one count a centre of the diagram.
template <typename T>
void descend(const Tree<T>& tree, const Level<T>& level, const Group& group, Level<T>& next, int32_t& filled,
             int32_t* place, int32_t* leaves) {
  const int32_t first = tree.child_offsets[group.diagram], size = tree.child_offsets[group.diagram + 1] - first;
  int32_t found[kBlock];
  nearest_centre_serial(level.points + 3 * group.begin, tree.centres + 3 * static_cast<int64_t>(first),
                        tree.weights == nullptr ? nullptr : tree.weights + first, tree.weight_bound, found,
                        group.end - group.begin, size, tree.isa);
  std::fill(place, place + size, 0);
  for (int32_t i = group.begin; i < group.end; ++i) {
    const int32_t centre = found[i - group.begin], child = tree.child[first + centre];
    if (child < 0) {
      leaves[level.rows[i]] = ~child;  // -child - 1, which could overflow
    } else {
      ++place[centre];
    }
  }
  for (int32_t c = 0; c < size; ++c) {
    if (place[c] == 0) continue;
    const int32_t count = place[c];
    next.groups[next.num_groups++] = {tree.child[first + c], filled, filled + count};
    place[c] = filled;
    filled += count;
  }
  for (int32_t i = group.begin; i < group.end; ++i) {
    const int32_t centre = found[i - group.begin];
    if (tree.child[first + centre] < 0) continue;
    const int32_t to = place[centre]++;
    next.rows[to] = level.rows[i];
    std::copy(level.points + 3 * i, level.points + 3 * i + 3, next.points + 3 * to);
  }
}

// False if a point is not at a leaf after the last level.
template <typename T>
bool locate_block(const Tree<T>& tree, const T* points, int32_t* leaves, int32_t n, int32_t* place) {
  Level<T> levels[2];
  std::copy(points, points + 3 * n, levels[0].points);
  for (int32_t i = 0; i < n; ++i) levels[0].rows[i] = i;
  levels[0].groups[0] = {0, 0, n};
  levels[0].num_groups = 1;
  for (int d = 0; d < tree.depth; ++d) {
    const Level<T>& level = levels[d % 2];
    Level<T>& next = levels[(d + 1) % 2];
    next.num_groups = 0;
    int32_t filled = 0;
    for (int i = 0; i < level.num_groups; ++i) descend(tree, level, level.groups[i], next, filled, place, leaves);
    if (filled == 0) return true;
  }
  return false;
}

}  // namespace

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

template <typename T>
bool locate_cell_cpu(const T* points, const T* centres, const T* weights, const int32_t* child_offsets,
                     const int32_t* child, int32_t* leaves, int32_t* workspace, int64_t n, int64_t m, int depth,
                     Isa isa, int threads) {
  const Tree<T> tree{centres, weights, nearest_centre_weight_bound(weights, m), child_offsets, child, depth, isa};
  const int64_t blocks = ceil_div<int64_t>(n, kBlock);
  std::atomic<bool> arrived{true};
  Items items(blocks);
  parallel(static_cast<int>(std::min<int64_t>(threads, blocks)), [&](int thread) {
    for (int64_t b, end; items.take(b, end);) {
      int32_t* place = workspace + thread * m;
      const int64_t start = b * kBlock;
      const int32_t rows = static_cast<int32_t>(std::min<int64_t>(kBlock, n - start));
      if (!locate_block(tree, points + 3 * start, leaves + start, rows, place)) {
        arrived.store(false, std::memory_order_relaxed);
      }
    }
  });
  return arrived;
}

template bool locate_cell_cpu(const float*, const float*, const float*, const int32_t*, const int32_t*, int32_t*,
                              int32_t*, int64_t, int64_t, int, Isa, int);
template bool locate_cell_cpu(const double*, const double*, const double*, const int32_t*, const int32_t*, int32_t*,
                              int32_t*, int64_t, int64_t, int, Isa, int);

}  // namespace voronerf
