// The hash encoding on the CPU. A task computes features or gradients of positions for a run of points, or the table's
// gradient for one level. Sums are in the order of the points, so results do not depend on the number of threads.
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

constexpr int64_t kRun = 16 * kHashBlock;  // points of one task

int64_t width_of(const HashEncoding& in) { return int64_t{in.count} * in.features; }

void encode_rows(Isa isa, const HashEncoding& in, float* out, int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, hash_encode_rows(in, out, width_of(in), begin, end))
}

void encode_level(Isa isa, const HashEncoding& in, int64_t level, float* out, int64_t stride, int64_t begin,
                  int64_t end) {
  VN_FOR_ISA(isa, hash_encode_level(in, level, out, stride, begin, end))
}

void level_rows(Isa isa, const HashEncoding& in, int64_t level, const float* gradient, int64_t stride, int64_t begin,
                int64_t end, float* of_table) {
  VN_FOR_ISA(isa, hash_encode_level_backward(in, level, gradient, stride, begin, end, of_table))
}

void positions_backward(Isa isa, const HashEncoding& in, const float* gradient, float* of_positions, int64_t begin,
                        int64_t end) {
  VN_FOR_ISA(isa, hash_encode_positions_backward(in, gradient, width_of(in), of_positions, begin, end))
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
  const HashEncoding call = hash_encoding(in, grid);
  for_points(in.n, threads, [&](int64_t begin, int64_t end) { encode_rows(isa, call, out, begin, end); });
}

void hash_level_cpu(const HashEncoding& in, int64_t level, float* out, int64_t stride, int64_t begin, int64_t end,
                    Isa isa) {
  encode_level(isa, in, level, out + level * in.features, stride, begin, end);
}

void hash_level_backward_cpu(const HashEncoding& in, int64_t level, const float* gradient, int64_t stride,
                             int64_t begin, int64_t end, float* of_table, Isa isa) {
  const GridLevel& grid_level = in.levels[level];
  for (int64_t table = 0; table < in.in.tables; ++table) {
    std::memset(of_table + (table * in.in.entries + grid_level.offset) * in.features, 0,
                sizeof(float) * static_cast<size_t>(grid_level.entries * in.features));
  }
  level_rows(isa, in, level, gradient, stride, begin, end, of_table);
}

void hash_encode_backward_cpu(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                              float* of_positions, Isa isa, int threads) {
  check(in);
  const HashEncoding call = hash_encoding(in, grid);
  if (of_positions != nullptr) {
    for_points(in.n, threads,
               [&](int64_t begin, int64_t end) { positions_backward(isa, call, gradient, of_positions, begin, end); });
  }
  if (of_table == nullptr) return;
  parallel_for(call.count, 1, threads, [&](int64_t level) {
    hash_level_backward_cpu(call, level, gradient, width_of(call), 0, in.n, of_table, isa);
  });
}

}  // namespace voronerf
