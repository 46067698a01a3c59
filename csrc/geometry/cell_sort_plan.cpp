#include "geometry/cell_sort.h"

namespace voronerf {

namespace {

// Rounds up to a multiple of 256 bytes: the alignment of a workspace's parts, which the toolkit's sort requires.
int64_t aligned(int64_t bytes) { return ceil_div<int64_t>(bytes, 256) * 256; }

}  // namespace

CellSortPlan cell_sort_plan(int64_t n, int64_t k, CellSortWay way, int64_t temporary) {
  CellSortPlan plan{};
  plan.buckets = k + 2;
  const bool few = plan.buckets <= kCellSortBuckets;
  VN_CHECK(few || way != CellSortWay::counting, "cell_sort: too many cells for counting in shared memory");
  plan.radix = way == CellSortWay::radix || !few;
  if (!plan.radix) {
    // Short chunks keep many warps busy, while long chunks need fewer counters: at most half as many counters as rows.
    plan.chunk_rows = 2 * plan.buckets < 1024 ? 1024 : 2 * plan.buckets;
    plan.chunks = ceil_div(ceil_div(n, plan.chunk_rows), kCellSortBlock) * kCellSortBlock;
    const int64_t size = plan.chunks * plan.buckets;
    plan.tiles = ceil_div(size, kCellSortScanTile);
    plan.tile_sums = aligned(4 * size);
    plan.bytes = plan.tile_sums + 4 * plan.tiles;
    return plan;
  }
  while (plan.bits < 32 && plan.buckets > int64_t{1} << plan.bits) ++plan.bits;
  plan.key_bytes = plan.bits <= 16 ? 2 : 4;
  plan.sorted = aligned(n * plan.key_bytes);
  plan.rows = 2 * plan.sorted;
  plan.temporary = plan.rows + aligned(4 * n);
  plan.bytes = plan.temporary + temporary;
  return plan;
}

}  // namespace voronerf
