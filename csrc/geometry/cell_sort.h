// Stable sort by cell: cells [n] -> order [n], offsets [k+1].
//
// The counting sort splits the rows into chunks, each with its own histogram. A chunk has more rows than there are
// cells, so the histograms are smaller than n.
#pragma once

#include <cstdint>

#include "common/common.h"
#include "common/row_count.h"

namespace voronerf {

// Returns false if a cell lies outside 0..k-1; `order` and `offsets` are then undefined.
bool cell_sort_cpu(const int32_t* cells, int32_t* order, int32_t* offsets, RowCount n, int64_t k, int threads);

// Writes the result for a diagram of one cell: all `cells` [n] are 0, and `offsets` [2] are 0 and n.
void one_cell_cpu(int32_t* cells, int32_t* offsets, RowCount n, int threads);

// The sorting method on CUDA: by counting if a warp's counters fit in shared memory, since this moves the fewest bytes
// (docs/cuda.md), else by the toolkit's radix sort. There are two more buckets than cells, for cells below 0 and cells
// from k on, because raising an error would need a host read.
enum class CellSortWay : int { automatic = 0, counting, radix };
constexpr int64_t kCellSortBuckets = 1024;  // most buckets of a warp: 32 KiB in a block
constexpr int64_t kCellSortBlock = 8;       // chunks of a block, also a bucket's counters in 32 bytes
constexpr int64_t kCellSortScanTile = 4096;

// The sizes of a sort, and the byte offset of each part of its workspace.
struct CellSortPlan {
  bool radix;
  int64_t buckets;
  // By counting: counts[bucket][chunk] and the sums of their scan's tiles, both int32.
  int64_t chunk_rows, chunks, tiles, counts, tile_sums;
  // By radix: every row's bucket as a key of `bits` bits, the sorted keys, the row numbers (int32), and last the sort's
  // temporary memory.
  int bits, key_bytes;
  int64_t keys, sorted, rows, temporary;
  int64_t bytes;
};

// Returns the plan of a sort, which depends on the arguments alone. `temporary`: bytes that the radix sort needs
// (radix_sort.h). Throws std::runtime_error if `way` is counting and there are too many cells.
CellSortPlan cell_sort_plan(int64_t n, int64_t k, CellSortWay way, int64_t temporary);

// Cells below 0 sort before offsets[0], and cells from k on after offsets[k], because raising an error would need a
// host read. The workspace's size in bytes depends on the current device; the host computes it. The workspace is
// aligned like torch's allocations.
int64_t cell_sort_workspace_cuda(int64_t n, int64_t k, CellSortWay way);
void cell_sort_cuda(const int32_t* cells, int32_t* order, int32_t* offsets, unsigned char* workspace, int64_t n,
                    int64_t k, CellSortWay way, void* stream);

}  // namespace voronerf
