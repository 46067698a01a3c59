// hash_encode (Mueller et al. 2022) and its gradients: positions [n,3] and a table [tables, entries, features] -> [n,
// levels x features], as in voronerf/ops/hash_encode/reference.py. If each point has a direction, the kernels compute
// the derivative along it instead of the value. Second derivatives use this mode
// (voronerf/ops/hash_encode/autograd.py).
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "common/isa.h"
#include "encoding/hash_encode_math.h"

namespace voronerf {

// A hash grid: its levels, its box from `low` to `high`, and the features of each level. It corresponds to HashGrid in
// voronerf/ops/_core/grids.py.
struct HashGrid {
  std::vector<GridLevel> levels;
  std::vector<float> low, high;
  int64_t features;
};

inline HashEncoding hash_encoding(const HashInputs& in, const HashGrid& grid) {
  HashEncoding result{};
  result.in = in;
  result.count = static_cast<int32_t>(grid.levels.size());
  result.features = static_cast<int32_t>(grid.features);
  for (int32_t i = 0; i < result.count; ++i) result.levels[i] = grid.levels[static_cast<std::size_t>(i)];
  for (std::size_t axis = 0; axis < 3; ++axis) {
    result.low[axis] = grid.low[axis];
    result.inverse[axis] = 1.0f / (grid.high[axis] - grid.low[axis]);
  }
  return result;
}

// Both CPU functions throw std::invalid_argument for a cell without a table.
void hash_encode_cpu(const HashInputs& in, const HashGrid& grid, float* out, Isa isa, int threads);

// gradient [n, levels x features] -> of_table and of_positions [n,3]; either may be null. of_table is float32 for any
// type of table. Every element is written.
void hash_encode_backward_cpu(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                              float* of_positions, Isa isa, int threads);

// Writes the features of one level for points `begin` to `end`; rows of the result are `stride` floats apart. This is a
// part of hash_encode_cpu, on the calling thread.
void hash_level_cpu(const HashEncoding& in, int64_t level, float* out, int64_t stride, int64_t begin, int64_t end,
                    Isa isa);

// Sets the gradient of one level's entries to the sum over points `begin` to `end`, in their order; rows of `gradient`
// are `stride` floats apart. This is a part of hash_encode_backward_cpu, on the calling thread.
void hash_level_backward_cpu(const HashEncoding& in, int64_t level, const float* gradient, int64_t stride,
                             int64_t begin, int64_t end, float* of_table, Isa isa);

// Points whose cell has no table get zeros and contribute no gradient. The table's gradient is summed in no fixed
// order.
void hash_encode_cuda(const HashInputs& in, const HashGrid& grid, float* out, void* stream);
void hash_encode_backward_cuda(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                               float* of_positions, void* stream);

}  // namespace voronerf
