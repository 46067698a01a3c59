// Stable counting sort on the CPU: a histogram a chunk, one scan over (cell, chunk), a scatter a chunk. Every row has
// one possible place in a stable order, so neither the chunks nor the threads can change the result.
//
// A thread takes up to kRun neighbouring chunks at a time: their histograms, and the places of their rows within a
// cell, lie side by side, and a cache line shared between threads costs more than the counting (5.9 ns a row for single
// chunks at k = 256, against 1.5 on one thread).
#include "geometry/cell_sort.h"

#include <algorithm>
#include <atomic>
#include <memory>

#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int64_t kRun = 16, kRuns = 8;  // of few chunks, so many runs at least

}  // namespace

bool cell_sort_cpu(const int32_t* cells, int32_t* order, int32_t* offsets, RowCount n, int64_t k, int threads) {
  const int64_t rows = cell_sort_chunk_rows(k), chunks = cell_sort_chunks(n, k);
  const int64_t run = std::clamp<int64_t>(chunks / kRuns, 1, kRun);
  const std::unique_ptr<int32_t[]> counts(new int32_t[static_cast<size_t>(chunks * k)]);
  int32_t* const workspace = counts.get();
  std::atomic<bool> valid{true};
  parallel_for(chunks, run, threads, [&](int64_t chunk) {
    int32_t* count = workspace + chunk * k;
    std::fill(count, count + k, 0);
    bool inside = true;
    for (int64_t i = chunk * rows, end = std::min<int64_t>(n, i + rows); i < end; ++i) {
      // As unsigned, a negative cell is above k as well.
      if (static_cast<uint32_t>(cells[i]) < static_cast<uint32_t>(k)) {
        ++count[cells[i]];
      } else {
        inside = false;
      }
    }
    if (!inside) valid.store(false, std::memory_order_relaxed);
  });
  if (!valid) return false;

  // In place, a count becomes the first place of that cell's rows of that chunk: walk the chunks once for the cells'
  // totals, once to hand out the places, both along the rows of the workspace. offsets[c + 1] is cell c's total, then
  // the next place to hand out, which begins at the cell's start and ends at its end.
  std::fill(offsets, offsets + k + 1, 0);
  for (int64_t chunk = 0; chunk < chunks; ++chunk) {
    for (int64_t c = 0; c < k; ++c) offsets[c + 1] += workspace[chunk * k + c];
  }
  int32_t start = 0;
  for (int64_t c = 0; c < k; ++c) {
    const int32_t total = offsets[c + 1];
    offsets[c + 1] = start;
    start += total;
  }
  for (int64_t chunk = 0; chunk < chunks; ++chunk) {
    for (int64_t c = 0; c < k; ++c) {
      const int32_t count = workspace[chunk * k + c];
      workspace[chunk * k + c] = offsets[c + 1];
      offsets[c + 1] += count;
    }
  }

  parallel_for(chunks, run, threads, [&](int64_t chunk) {
    int32_t* place = workspace + chunk * k;
    for (int64_t i = chunk * rows, end = std::min<int64_t>(n, i + rows); i < end; ++i) {
      order[place[cells[i]]++] = static_cast<int32_t>(i);
    }
  });
  return true;
}

void one_cell_cpu(int32_t* cells, int32_t* offsets, RowCount n, int /*threads*/) {
  std::fill(cells, cells + n, 0);
  offsets[0] = 0;
  offsets[1] = static_cast<int32_t>(n);
}

}  // namespace voronerf
