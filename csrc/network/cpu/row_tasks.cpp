#include "network/cpu/row_tasks.h"

#include <memory>
#include <new>
#include <stdexcept>

#include "common/common.h"

namespace voronerf {

namespace {

// The desired number of tasks.
constexpr int64_t kTasks = 64;
// The most floats that a thread keeps between calls.
constexpr int64_t kKeptFloats = 2 * kPartialFloats;
constexpr std::align_val_t kAlign{64};  // Windows has no std::aligned_alloc

struct Free {
  void operator()(float* memory) const { ::operator delete(memory, kAlign); }
};

struct Block {
  std::unique_ptr<float, Free> memory;
  int64_t size = 0;
};

thread_local Block kept;

}  // namespace

Workspace::Workspace(int64_t floats) {
  if (floats <= kept.size) return;
  kept = Block{};
  kept.memory.reset(static_cast<float*>(::operator new(static_cast<size_t>(floats) * sizeof(float), kAlign)));
  kept.size = floats;
}

Workspace::~Workspace() {
  if (kept.size > kKeptFloats) kept = Block{};
}

float* Workspace::data() const { return kept.memory.get(); }

void check_offsets(const std::string& op, const int32_t* offsets, int64_t k, int64_t n) {
  int64_t previous = 0;
  for (int64_t c = 0; c <= k; ++c) {
    if (offsets[c] < previous || offsets[c] > n) {
      throw std::invalid_argument(op + ": offsets must ascend within 0 to " + std::to_string(n) +
                                  " (the number of rows), got " + std::to_string(offsets[c]) + " for cell " +
                                  std::to_string(c));
    }
    previous = offsets[c];
  }
}

int64_t tile_rows() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_is("intel") || !__builtin_cpu_supports("avx512f")) return 48;
#endif
  return 96;
}

RowTasks split_rows(const int32_t* offsets, int64_t k, int64_t n, RowLimits limits, int64_t unit, int64_t partial) {
  int64_t target = std::clamp(n / kTasks, limits.fewest, limits.most);
  if (partial > 0) target = std::max(target, n / std::max<int64_t>(kPartialFloats / partial, 1));
  RowTasks result;
  result.first_partial.assign(k + 1, 0);
  int64_t partials = 0;
  for (int64_t c = 0; c < k; ++c) {
    const int64_t begin = offsets[c], rows = offsets[c + 1] - begin;
    const int64_t count = ceil_div(rows, target);
    const int64_t size = count > 1 ? ceil_div(ceil_div(rows, count), unit) * unit : rows;
    for (int64_t start = 0; start < rows; start += size) {
      result.tasks.push_back({c, begin + start, begin + std::min(rows, start + size), count > 1 ? partials++ : -1});
    }
    result.first_partial[c + 1] = partials;
  }
  return result;
}

}  // namespace voronerf
