// Stable counting sort by cell: cells [n] -> order [n], offsets [k+1].
//
// The rows are cut into chunks of cell_sort_chunk_rows(k), each with its own histogram in the workspace
// [cell_sort_workspace(n, k)]; a chunk has many more rows than there are cells, so the histograms stay a fraction of n.
#pragma once

#include <cstdint>

#include "common.h"

namespace voronerf {

// Two counts more than cells: below 0 and from k on, which CUDA sorts to the ends (it cannot raise without a host
// read).
inline int64_t cell_sort_chunk_rows(int64_t k) {
  return 4 * (k + 2) < 2048 ? 2048 : 4 * (k + 2);
}
inline int64_t cell_sort_chunks(int64_t n, int64_t k) {
  return ceil_div(n, cell_sort_chunk_rows(k));
}

// int32 elements of workspace: the histograms and, for CUDA's scan, the sums of its tiles.
constexpr int64_t kScanTile = 4096;
inline int64_t cell_sort_workspace(int64_t n, int64_t k) {
  const int64_t counts = cell_sort_chunks(n, k) * (k + 2);
  return counts + ceil_div(counts, kScanTile);
}

// False if a cell lies outside 0..k-1; `order` and `offsets` are then undefined.
bool cell_sort_cpu(const int32_t* cells, int32_t* order, int32_t* offsets, int32_t* workspace, int64_t n, int64_t k,
                   int threads);

}  // namespace voronerf
