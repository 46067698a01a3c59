// Tasks and workspaces of operations on rows sorted by cell. A task is a cell and a range of its rows. The tasks depend
// only on the sizes, and partial weight gradients are summed in the order of the rows. So results do not depend on the
// number of threads or on the assignment of tasks to threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

#include "common/flush_denormals.h"
#include "common/parallel.h"

namespace voronerf {

struct RowTask {
  int64_t cell, begin, end;
  int64_t partial;  // index of the task's partial; -1: it is the cell's only task
};

struct RowTasks {
  std::vector<RowTask> tasks;
  std::vector<int64_t> first_partial;  // [k+1], by cell

  int64_t partials(int64_t cell) const { return first_partial[cell + 1] - first_partial[cell]; }
};

// The limits of a task's rows: enough rows to pay for packing the weights, and few enough to keep all threads busy to
// the end.
struct RowLimits {
  int64_t fewest, most;
};
// The most floats of partial weight gradients in a call: wide networks get longer tasks instead of more memory.
constexpr int64_t kPartialFloats = int64_t{1} << 24;

// Throws std::invalid_argument unless offsets [k+1] never decrease and lie in 0..n.
void check_offsets(const std::string& op, const int32_t* offsets, int64_t k, int64_t n);

// Splits n rows into tasks. If a cell has several tasks, their sizes are multiples of `unit`, except the last.
// `partial`, the floats of one partial (0: none), limits the number of tasks.
RowTasks split_rows(const int32_t* offsets, int64_t k, int64_t n, RowLimits limits, int64_t unit, int64_t partial);

// Returns the number of rows of a tile, a multiple of all blocks of rows (6, 8, 12). On AMD's Zen 4 and 5, 96 rows are
// the fastest of 48, 96, 144 and 192; 48 rows take 1.015 times as long. Elsewhere the choice follows from cache sizes,
// not measurements. On Intel, a layer of width 64 reads and writes 40 KiB with 48 rows, which fits the first-level
// cache of 48 KiB. With 96 rows, every line of the layer's result is written back to the second-level cache, and a load
// waits for an earlier store if their addresses differ by a multiple of 4 KiB. On AMD without AVX-512 the first-level
// cache has 32 KiB. With 96 rows, the two operands of a weight gradient have 12 lines in each of 16 sets of 8 lines,
// and miss 3.1 times as often as with 48 rows.
int64_t tile_rows();

// The memory of one call, aligned to a cache line. The calling thread keeps it for later calls until it ends, since the
// first touch of a fresh page costs a microsecond. A block of more than kKeptFloats (twice the partials of a wide
// network) is freed at the end of the call.
class Workspace {
 public:
  explicit Workspace(int64_t floats);
  ~Workspace();
  Workspace(const Workspace&) = delete;
  Workspace& operator=(const Workspace&) = delete;
  float* data() const;
};

// Runs all tasks on the threads. For each task a thread calls pack(cell, own, first) if its previous task had another
// cell (first: there was no previous task), ahead(cell) for its most likely next cell, and run(task, own). `own` is the
// thread's part of `memory`, `stride` floats.
template <typename Pack, typename Ahead, typename Run>
void for_each_task(const RowTasks& tasks, float* memory, int64_t stride, int threads, const Pack& pack,
                   const Ahead& ahead, const Run& run) {
  const int64_t count = static_cast<int64_t>(tasks.tasks.size());
  Items items(count, 1, threads);
  parallel(static_cast<int>(std::min<int64_t>(threads, count)), [&](int thread) {
    const FlushDenormals flush;
    float* own = memory + thread * stride;
    int64_t packed = -1;
    for (int64_t i, end; items.take(thread, i, end);) {
      const RowTask& task = tasks.tasks[i];
      if (task.cell != packed) pack(task.cell, own, packed < 0);
      packed = task.cell;
      const int64_t next = i + 1;
      if (next < count && tasks.tasks[next].cell != packed) ahead(tasks.tasks[next].cell);
      run(task, own);
    }
  });
}

}  // namespace voronerf
