// Shared by the operations over rows sorted by cell: their tasks, and the memory of a call. A task is a cell and a
// range of its rows. Which tasks there are depends on the sizes alone, and partial weight gradients are summed in the
// order of the rows, so results do not depend on the number of threads or on which thread took what.
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
  int64_t partial;  // index of its partial; -1: the cell's only task
};

struct RowTasks {
  std::vector<RowTask> tasks;
  std::vector<int64_t> first_partial;  // [k+1] for each cell

  int64_t partials(int64_t cell) const { return first_partial[cell + 1] - first_partial[cell]; }
};

// Rows of a task: at least enough to pay for packing the weights, at most so few that all threads are busy to the end.
struct RowLimits {
  int64_t fewest, most;
};
// Partial weight gradients of one call, in floats: wide networks get longer tasks instead of more memory.
constexpr int64_t kPartialFloats = int64_t{1} << 24;

// Throws std::invalid_argument unless offsets [k+1] rise from 0 or more to at most n.
void check_offsets(const std::string& op, const int32_t* offsets, int64_t k, int64_t n);

// Tasks of n rows; those of a cell that is cut are whole multiples of `unit`, but for its last. `partial`, the floats
// of one partial, bounds how many there are; 0 for a call that has none.
RowTasks split_rows(const int32_t* offsets, int64_t k, int64_t n, RowLimits limits, int64_t unit, int64_t partial);

// Rows of a tile: a multiple of all blocks of rows (6, 8, 12), of 48, 96, 144 and 192. 96 is the fastest on AMD's Zen 4
// and 5, 48 takes 1.015 times as long there. Elsewhere it is counted, not measured. On Intel what a layer of width 64
// reads and writes, 40 KiB with 48 rows, lies in the first-level cache of 48 KiB; with 96 every line of C is stored to
// the second level, and until it is there a load 4 KiB apart waits for it. On AMD without AVX-512 that cache has 32
// KiB: 96 rows of the two operands of a weight gradient are 12 lines of each of 16 sets, which hold 8, and miss 3.1
// times as often as 48.
int64_t tile_rows();

// Memory for one call, aligned to a cache line. It belongs to the calling thread and is kept from one call to the next
// until the thread ends, since a fresh page costs a microsecond at its first touch; a block larger than the partials of
// a wide network and as much again goes back at the end of the call.
class Workspace {
 public:
  explicit Workspace(int64_t floats);
  ~Workspace();
  Workspace(const Workspace&) = delete;
  Workspace& operator=(const Workspace&) = delete;
  float* data() const;
};

// What a thread does with its tasks: pack(cell, own, first) where a task's cell is not that of its last one (first:
// there was none), ahead(cell) for the cell that is most likely its next, run(task, own). `own` is the thread's part of
// `memory`, `stride` floats.
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
