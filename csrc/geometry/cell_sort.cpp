// Stable sort on the CPU by counting: a histogram per chunk, one scan over (cell, chunk), a scatter per chunk. A stable
// order is unique, so neither the chunks nor the threads change the result.
//
// The last chunk counts in `offsets`, and its scatter leaves the final offsets there, so a single chunk needs no
// memory. A thread has two chunks if their counters fit in the L1 cache, and scatters their rows alternately: a row
// waits seven cycles for the counter if the previous row has the same cell. For sorted rows, alternating takes 1.5 ns
// per row instead of 2.7.
#include "geometry/cell_sort.h"

#include <algorithm>
#include <atomic>
#include <memory>

#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int64_t kSparse = 64;       // from this many cells per row, rows are sorted by digits
constexpr int64_t kChunkRows = 2048;  // minimum rows of a chunk, which also has at least four per cell
constexpr int64_t kTwoChunks = 4096;  // cells for which two sets of counters fit in the L1 cache
constexpr int64_t kNear = 1 << 17;    // rows whose order stays in the L2 cache
constexpr int64_t kLine = 16;         // int32 of a cache line

// Returns whether a cell lies in 0..k-1. As an unsigned number, a negative cell is above k too.
bool inside(int32_t cell, int64_t k) { return static_cast<uint32_t>(cell) < static_cast<uint32_t>(k); }

// Replaces counts of rows by the positions of the first rows in the sorted order: an exclusive prefix sum. Two cells at
// a time take 0.28 ns a cell; one at a time takes 0.31 to 0.55 ns, depending on the loop's alignment.
void first_places(int32_t* counts, int64_t k) {
  int32_t start = 0;
  int64_t c = 0;
  for (; c + 1 < k; c += 2) {
    const int32_t next = start + counts[c], end = next + counts[c + 1];
    counts[c] = start;
    counts[c + 1] = next;
    start = end;
  }
  if (c < k) counts[c] = start;
}

// Sorts few rows into many cells: by the lower half of a cell's bits, then by the upper half, with about sqrt(k)
// counters each. Writes offsets once, in order.
bool sort_sparse(const int32_t* cells, int32_t* order, int32_t* offsets, int64_t n, int64_t k) {
  int bits = 0;
  while ((k - 1) >> 2 * bits != 0) ++bits;
  const int64_t digits = int64_t{1} << bits, mask = digits - 1;
  const std::unique_ptr<int32_t[]> memory(new int32_t[static_cast<size_t>(2 * digits + n)]);
  int32_t *const lower = memory.get(), *const upper = lower + digits, *const rows = upper + digits;
  std::fill(lower, rows, 0);
  for (int64_t i = 0; i < n; ++i) {
    if (!inside(cells[i], k)) return false;
    ++lower[cells[i] & mask];
    ++upper[cells[i] >> bits];
  }
  first_places(lower, digits);
  first_places(upper, digits);
  for (int64_t i = 0; i < n; ++i) rows[lower[cells[i] & mask]++] = static_cast<int32_t>(i);
  for (int64_t i = 0; i < n; ++i) order[upper[cells[rows[i]] >> bits]++] = rows[i];
  int32_t* next = offsets;
  for (int64_t i = 0; i < n; ++i) {
    for (int32_t* const end = offsets + cells[order[i]] + 1; next < end; ++next) *next = static_cast<int32_t>(i);
  }
  std::fill(next, offsets + k + 1, static_cast<int32_t>(n));
  return true;
}

}  // namespace

bool cell_sort_cpu(const int32_t* cells, int32_t* order, int32_t* offsets, RowCount n, int64_t k, int threads) {
  if (kSparse * n <= k) return sort_sparse(cells, order, offsets, n, k);
  // Each thread has one part, which consists of one or two chunks.
  const int64_t sides = k <= kTwoChunks && n >= 8 * k ? 2 : 1;
  const int64_t parts = std::clamp<int64_t>(n / (sides * std::max(kChunkRows, 4 * k)), 1, threads);
  const int64_t chunks = sides * parts, rows = ceil_div<int64_t>(n, chunks);
  const int64_t stride = (ceil_div(k, kLine) + 1) * kLine;  // avoids false sharing of counters
  const std::unique_ptr<int32_t[]> memory(new int32_t[static_cast<size_t>((chunks - 1) * stride)]);
  const auto counters = [&](int64_t chunk) { return chunk < chunks - 1 ? memory.get() + chunk * stride : offsets + 1; };
  const auto start = [&](int64_t chunk) { return std::min<int64_t>(n, chunk * rows); };
  // Calls take(row, counters) for the rows of a part, alternately from both chunks. The second chunk has at most as
  // many rows as the first.
  const auto walk = [&](int64_t part, const auto& take) {
    const int64_t chunk = sides * part, middle = start(chunk + 1), half = middle - start(chunk);
    int32_t *const first = counters(chunk), *const second = counters(chunk + sides - 1);
    int64_t row = start(chunk);
    for (const int64_t both = start(chunk + sides) - half; row < both; ++row) {
      take(row, first);
      take(row + half, second);
    }
    for (; row < middle; ++row) take(row, first);
  };

  std::atomic<bool> valid{true};
  parallel_for(parts, 1, threads, [&](int64_t part) {
    for (int64_t chunk = sides * part; chunk < sides * (part + 1); ++chunk) {
      std::fill(counters(chunk), counters(chunk) + k, 0);
    }
    bool all_inside = true;
    walk(part, [&](int64_t row, int32_t* count) {
      if (inside(cells[row], k)) {
        ++count[cells[row]];
      } else {
        all_inside = false;
      }
    });
    if (!all_inside) valid.store(false, std::memory_order_relaxed);
  });
  if (!valid) return false;

  // Each count is replaced by the position, in the sorted order, of the first of the cell's rows in the chunk. One pass
  // over the chunks sums the cells' totals, a second pass assigns positions; both read memory in order. The last
  // chunk's counters hold the total, then the next free position, and in the end that chunk's own first position.
  int32_t* const last = offsets + 1;
  for (int64_t chunk = 0; chunk < chunks - 1; ++chunk) {
    const int32_t* const count = counters(chunk);
    for (int64_t c = 0; c < k; ++c) last[c] += count[c];
  }
  first_places(last, k);
  for (int64_t chunk = 0; chunk < chunks - 1; ++chunk) {
    int32_t* const place = counters(chunk);
    for (int64_t c = 0; c < k; ++c) {
      const int32_t count = place[c];
      place[c] = last[c];
      last[c] += count;
    }
  }

  offsets[0] = 0;
  // If the order outgrows the cache and the rows of a cell span several cache lines, the cell's next line is
  // prefetched.
  const bool far = n > kNear + 128 * k;
  parallel_for(parts, 1, threads, [&](int64_t part) {
    walk(part, [cells, order, far](int64_t row, int32_t* places) {
      const int32_t place = places[cells[row]]++;
      if (far) __builtin_prefetch(order + place + kLine, 1);
      order[place] = static_cast<int32_t>(row);
    });
  });
  return true;
}

void one_cell_cpu(int32_t* cells, int32_t* offsets, RowCount n, int /*threads*/) {
  std::fill(cells, cells + n, 0);
  offsets[0] = 0;
  offsets[1] = static_cast<int32_t>(n);
}

}  // namespace voronerf
