// Points go down a tree of diagrams on the CPU, a block at a time. At each level the block's points are grouped by
// diagram, and the nearest centres of a group are found together. A counting sort by centre then forms the groups of
// the next level. A point costs the sum of its diagrams' sizes (32 centres for 16 x 16 cells, not 256), and the block
// stays in the L2 cache throughout. The caller provides the function that finds a centre.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>

#include "common/common.h"
#include "common/parallel.h"

namespace voronerf {

constexpr int kDescentBlock = 2048;

// Diagram j owns rows child_offsets[j] : child_offsets[j+1] of the centres; child and depth as in locate_cell.h.
struct DescentTree {
  const int32_t *child_offsets, *child;
  int depth;
};

// Rows begin:end of the block are in this diagram.
struct DescentGroup {
  int32_t diagram, begin, end;
};

// The points of a level, their rows in the block, and their groups. No group is empty, so kDescentBlock groups suffice.
template <typename T>
struct DescentLevel {
  T points[3 * kDescentBlock];
  int32_t rows[kDescentBlock];
  DescentGroup groups[kDescentBlock];
  int num_groups;
};

// The working memory of a block, in the caller's workspace because thread stacks may be smaller.
template <typename T>
struct DescentBlock {
  DescentLevel<T> levels[2];
  int32_t nearest[kDescentBlock];
};

// Returns the workspace's size in int32 for each thread: a block of either dtype, and m counts.
inline int64_t descent_stride(int64_t m) {
  return static_cast<int64_t>(sizeof(DescentBlock<double>) / sizeof(int32_t)) + ceil_div<int64_t>(m, 16) * 16;
}

// Processes one group: writes leaves and appends the other points to `next`. `place` holds one count for each centre of
// the diagram.
template <typename T, typename Find>
void descend_group(const DescentTree& tree, const DescentLevel<T>& level, int depth, const DescentGroup& group,
                   DescentLevel<T>& next, int32_t& filled, int32_t* nearest, int32_t* place, int32_t* leaves,
                   const Find& find) {
  const int32_t first = tree.child_offsets[group.diagram], size = tree.child_offsets[group.diagram + 1] - first;
  find(level.points + 3 * group.begin, level.rows + group.begin, group.end - group.begin, first, size, depth, nearest);
  std::fill(place, place + size, 0);
  for (int32_t i = group.begin; i < group.end; ++i) {
    const int32_t centre = nearest[i - group.begin], child = tree.child[first + centre];
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
    const int32_t centre = nearest[i - group.begin];
    if (tree.child[first + centre] < 0) continue;
    const int32_t to = place[centre]++;
    next.rows[to] = level.rows[i];
    std::copy(level.points + 3 * i, level.points + 3 * i + 3, next.points + 3 * to);
  }
}

// Moves the n points of a block down the tree. Returns false if a point is not at a leaf after the last level.
template <typename T, typename Find>
bool descend_block(const DescentTree& tree, const T* points, int32_t* leaves, int32_t n, DescentBlock<T>& block,
                   int32_t* place, const Find& find) {
  DescentLevel<T>* levels = block.levels;
  std::copy(points, points + 3 * n, levels[0].points);
  for (int32_t i = 0; i < n; ++i) levels[0].rows[i] = i;
  levels[0].groups[0] = {0, 0, n};
  levels[0].num_groups = 1;
  for (int d = 0; d < tree.depth; ++d) {
    const DescentLevel<T>& level = levels[d % 2];
    DescentLevel<T>& next = levels[(d + 1) % 2];
    next.num_groups = 0;
    int32_t filled = 0;
    for (int i = 0; i < level.num_groups; ++i) {
      descend_group(tree, level, d, level.groups[i], next, filled, block.nearest, place, leaves, find);
    }
    if (filled == 0) return true;
  }
  return false;
}

// Moves all n points to their leaves; threads share the blocks. `workspace` holds descent_stride(m) int32 for each
// thread and is aligned to 8 bytes. Returns false if a point does not reach a leaf.
//
// find(points, rows, count, first, size, level, found, start, thread) finds a centre for each of `count` points. The
// centres are the rows first : first + size, and found[i] gets the index of the centre of point i, counted from
// `first`. `level` is the level of the tree, from 0, and `thread` the index of the calling thread. Among all points,
// point i is row start + rows[i].
template <typename T, typename Find>
bool descend(const DescentTree& tree, const T* points, int32_t* leaves, int32_t* workspace, int64_t n, int64_t m,
             int threads, const Find& find) {
  const int64_t blocks = ceil_div<int64_t>(n, kDescentBlock);
  std::atomic<bool> arrived{true};
  Items items(blocks, 1, threads);
  parallel(static_cast<int>(std::min<int64_t>(threads, blocks)), [&](int thread) {
    int32_t* memory = workspace + thread * descent_stride(m);
    auto& block = *reinterpret_cast<DescentBlock<T>*>(memory);
    int32_t* place = memory + sizeof(DescentBlock<double>) / sizeof(int32_t);
    for (int64_t b, end; items.take(thread, b, end);) {
      const int64_t start = b * kDescentBlock;
      const int32_t rows = static_cast<int32_t>(std::min<int64_t>(kDescentBlock, n - start));
      const auto in_block = [&](const T* at, const int32_t* which, int32_t count, int32_t first, int32_t size,
                                int level, int32_t* nearest) {
        find(at, which, count, first, size, level, nearest, start, thread);
      };
      if (!descend_block(tree, points + 3 * start, leaves + start, rows, block, place, in_block)) {
        arrived.store(false, std::memory_order_relaxed);
      }
    }
  });
  return arrived;
}

}  // namespace voronerf
