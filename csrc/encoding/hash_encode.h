// hash_encode (Mueller et al. 2022) with its gradients: positions [n,3] and a table [tables, entries, features] ->
// [n, levels x features], as in voronerf/ops/hash_encode/reference.py. With a direction for each point everything is of
// the derivative along it, with which second derivatives are made of the same kernels
// (voronerf/ops/hash_encode/autograd.py).
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "common/isa.h"
#include "encoding/hash_encode_math.h"

namespace voronerf {

// As in voronerf/ops/_core/grids.py; the table's shape without its number of tables.
struct HashGrid {
  std::vector<GridLevel> levels;
  std::vector<float> low, high;
  int64_t features;
  bool smooth;
};

inline HashEncoding hash_encoding(const HashInputs& in, const HashGrid& grid) {
  HashEncoding made{};
  made.in = in;
  made.count = static_cast<int32_t>(grid.levels.size());
  made.features = static_cast<int32_t>(grid.features);
  made.smooth = grid.smooth;
  for (int32_t i = 0; i < made.count; ++i) made.levels[i] = grid.levels[static_cast<std::size_t>(i)];
  for (std::size_t axis = 0; axis < 3; ++axis) {
    made.low[axis] = grid.low[axis];
    made.inverse[axis] = 1.0f / (grid.high[axis] - grid.low[axis]);
  }
  return made;
}

// Throw std::invalid_argument for a cell without a table.
void hash_encode_cpu(const HashInputs& in, const HashGrid& grid, float* out, Isa isa, int threads);

// gradient [n, levels x features] -> of_table, in float32 whatever the type of the table, and of_positions [n,3]; null
// where not wanted. Every element is written.
void hash_encode_backward_cpu(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                              float* of_positions, Isa isa, int threads);

// Features of one level for points `begin` to `end` of a result whose rows are `stride` floats apart. A part of
// hash_encode_cpu, on the calling thread.
void hash_level_cpu(const HashEncoding& in, int64_t level, float* out, int64_t stride, int64_t begin, int64_t end,
                    Isa isa);

// Gradient of one level's entries, zero before: what points `begin` to `end` give, in their order, of a gradient whose
// rows are `stride` floats apart. A part of hash_encode_backward_cpu, on the calling thread.
void hash_level_backward_cpu(const HashEncoding& in, int64_t level, const float* gradient, int64_t stride,
                             int64_t begin, int64_t end, float* of_table, Isa isa);

// Points whose cell has no table get zeros and give nothing. The table's gradient is added up in any order.
void hash_encode_cuda(const HashInputs& in, const HashGrid& grid, float* out, void* stream);
void hash_encode_backward_cuda(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                               float* of_positions, void* stream);

}  // namespace voronerf
