// The hash encoding on the CPU. Features and gradients of positions by runs of points; the table's gradient by levels,
// each added up in the order of the points, so that results do not depend on the number of threads.
#include "encoding/hash_encode.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>

#include "common/common.h"
#include "common/parallel.h"
#include "encoding/hash_encode_isa.h"

namespace voronerf {

namespace {

constexpr int64_t kRun = 16 * kHashBlock;  // points of a task

void encode_rows(Isa isa, const HashEncoding& in, float* out, int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, hash_encode_rows(in, out, begin, end))
}

void level_backward(Isa isa, const HashEncoding& in, int64_t level, const float* gradient, float* of_table) {
  VN_FOR_ISA(isa, hash_encode_level_backward(in, level, gradient, of_table))
}

void positions_backward(Isa isa, const HashEncoding& in, const float* gradient, float* of_positions, int64_t begin,
                        int64_t end) {
  VN_FOR_ISA(isa, hash_encode_positions_backward(in, gradient, of_positions, begin, end))
}

void check(const HashInputs& in) {
  if (in.cells == nullptr || in.n == 0) return;
  const auto [first, last] = std::minmax_element(in.cells, in.cells + in.n);
  if (*first >= 0 && *last < in.tables) return;
  throw std::invalid_argument("hash_encode: cells must lie in 0 to " + std::to_string(in.tables - 1) +
                              ", got values from " + std::to_string(*first) + " to " + std::to_string(*last));
}

template <typename Run>
void for_points(int64_t n, int threads, const Run& run) {
  parallel_for(ceil_div(n, kRun), 1, threads, [&](int64_t i) { run(i * kRun, std::min(n, (i + 1) * kRun)); });
}

}  // namespace

void hash_encode_cpu(const HashInputs& in, const HashGrid& grid, float* out, Isa isa, int threads) {
  check(in);
  const HashEncoding given = hash_encoding(in, grid);
  for_points(in.n, threads, [&](int64_t begin, int64_t end) { encode_rows(isa, given, out, begin, end); });
}

void hash_encode_backward_cpu(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                              float* of_positions, Isa isa, int threads) {
  check(in);
  const HashEncoding given = hash_encoding(in, grid);
  if (of_positions != nullptr) {
    for_points(in.n, threads,
               [&](int64_t begin, int64_t end) { positions_backward(isa, given, gradient, of_positions, begin, end); });
  }
  if (of_table == nullptr) return;
  parallel_for(given.count, 1, threads, [&](int64_t i) {
    const GridLevel& level = given.levels[i];
    for (int64_t table = 0; table < in.tables; ++table) {
      std::memset(of_table + (table * in.entries + level.offset) * grid.features, 0,
                  sizeof(float) * static_cast<size_t>(level.entries * grid.features));
    }
    level_backward(isa, given, i, gradient, of_table);
  });
}

}  // namespace voronerf
