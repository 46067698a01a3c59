// A whole small network for each cell, on samples sorted by cell: encode, layers with skips and branches, and the
// gradients.
//
// n samples, r rays, k cells, p and q features of a raw position and direction. All tensors are float32 and contiguous.
//   positions [n,p], directions [n,q] or [r,q] with direction_index [n], offsets [k+1], weights[l] [k,o,i], biases[l]
//   [k,o] or null
// Rows outside all cells (before offsets[0], from offsets[k] on) give 0. Results do not depend on the number of
// threads.
//
// With `order` [n] the samples lie anywhere: the row i that the offsets speak of is row order[i] of positions,
// directions, direction_index, output and gradients. Rows are gathered and scattered by the tiles, so that nothing is
// permuted in memory.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "common/isa.h"
#include "encoding/hash_encode.h"
#include "network/grouped_mlp_encoding.h"

namespace voronerf {

enum class Activation : int { none = 0, relu, softplus, sigmoid, sine };

// The operation named in errors.
enum class MlpCaller : int { grouped_mlp = 0, grouped_linear, routed_mlp };

constexpr int kFromPositions = -1;
constexpr int kFromDirections = -2;

struct MlpLayer {
  int64_t width;
  Activation activation;
  std::vector<int> inputs;  // earlier layers, kFromPositions or kFromDirections
};

// The layer table of voronerf/ops/_core/layers.py.
struct MlpTable {
  std::vector<MlpLayer> layers;
  std::vector<int> outputs;
  int64_t positions = 0, directions = 0;  // p and q
  MlpEncoding position, direction;
  HashGrid grid{};    // of positions that are hashed
  bool half = false;  // round what enters a product to bfloat16, where the processor multiplies that faster
  MlpCaller caller = MlpCaller::grouped_mlp;
};

struct MlpInputs {
  const float* positions;
  const float* directions;         // or null
  const int32_t* direction_index;  // or null: one direction a sample
  const int32_t* offsets;
  const float* const* weights;
  const float* const* biases;
  int64_t n, r, k;
  const int32_t* order = nullptr;  // null: rows are sorted
  // Of a hash grid: [entries, features], or one for each cell, [k, entries, features].
  const void* features = nullptr;
  TableType features_type = TableType::float32;
  int64_t tables = 1;
  // Hashed positions [n, encoded_width rounded up to 16] in their sorted order: filled by the forward pass where it is
  // not null, read by the backward pass.
  float* encoded = nullptr;
};

// Where gradients go; every element is written. Null: not wanted (weights: all or none; a layer without bias has null).
struct MlpGradients {
  const float* output;  // [n, out], the incoming one
  float* const* weights;
  float* const* biases;
  float* positions;
  float* directions;  // [n,q], or [r,q] summed over each ray's samples in their order
  // In float32 whatever their type, each entry summed over the rows in their sorted order; on CUDA in any order.
  float* features = nullptr;
};

// Throws std::invalid_argument for offsets that fall or exceed n and for a direction_index out of range.
void grouped_mlp_cpu(const MlpTable& table, const MlpInputs& inputs, float* out, Isa isa, int threads);

// Activations are recomputed tile by tile instead of kept since the forward pass.
void grouped_mlp_backward_cpu(const MlpTable& table, const MlpInputs& inputs, const MlpGradients& gradients, Isa isa,
                              int threads);

}  // namespace voronerf
