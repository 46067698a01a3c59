// Stable sort by cell: cells [n] -> order [n], offsets [k+1].
//
// By counting, the rows are cut into chunks, each with its own histogram; a chunk has more rows than there are cells,
// so the histograms stay a fraction of n.
#pragma once

#include <cstdint>

#include "common/common.h"
#include "common/row_count.h"

namespace voronerf {

// False if a cell lies outside 0..k-1; `order` and `offsets` are then undefined.
bool cell_sort_cpu(const int32_t* cells, int32_t* order, int32_t* offsets, RowCount n, int64_t k, int threads);

// All samples in one cell: cells 0, offsets 0 and n.
void one_cell_cpu(int32_t* cells, int32_t* offsets, RowCount n, int threads);

// How CUDA sorts: by counting where a warp's counters fit shared memory, which by counting bytes is the better way as
// long as it is possible (docs/cuda.md), else by the toolkit's radix sort. It has two buckets more than there are
// cells, for those below 0 and from k on: it cannot raise without a host read.
enum class CellSortWay : int { automatic = 0, counting, radix };
constexpr int64_t kCellSortBuckets = 1024;  // of a warp: 32 KiB of a block
constexpr int64_t kCellSortBlock = 8;       // chunks of a block, and the counters of a bucket in 32 bytes
constexpr int64_t kCellSortScanTile = 4096;

// Sizes and the bytes of workspace in front of each part, a pure function.
struct CellSortPlan {
  bool radix;
  int64_t buckets;
  // By counting: counts[bucket][chunk] and the sums of the tiles of their scan, int32 both.
  int64_t chunk_rows, chunks, tiles, counts, tile_sums;
  // By radix: every row's bucket, by `bits` of which is sorted; the same sorted; the rows' numbers, int32; and what the
  // sort itself takes, the last part.
  int bits, key_bytes;
  int64_t keys, sorted, rows, temporary;
  int64_t bytes;
};

// `temporary`: bytes that the radix sort takes (radix_sort.h). Throws std::runtime_error where cells cannot be counted.
CellSortPlan cell_sort_plan(int64_t n, int64_t k, CellSortWay way, int64_t temporary);

// A cell below 0 sorts before offsets[0], one from k on after offsets[k]: raising would need a host read.
// The workspace's size depends on the current device and is known to the host; aligned as torch's allocations are.
int64_t cell_sort_workspace_cuda(int64_t n, int64_t k, CellSortWay way);
void cell_sort_cuda(const int32_t* cells, int32_t* order, int32_t* offsets, unsigned char* workspace, int64_t n,
                    int64_t k, CellSortWay way, void* stream);

}  // namespace voronerf
