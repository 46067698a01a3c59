// A whole small network for each cell, on samples sorted by cell: encode, layers with skips and branches, and the
// gradients.
//
// n samples, r rays, k cells, p and q features of a raw position and direction. All tensors are float32 and contiguous.
//   positions [n,p], directions [n,q] or [r,q] with direction_index [n], offsets [k+1], weights[l] [k,o,i], biases[l]
//   [k,o] or null
// Rows of no cell (before offsets[0], from offsets[k] on) give 0. Results do not depend on the number of threads.
//
// With `order` [n] the samples lie anywhere: the row i that the offsets speak of is row order[i] of positions,
// directions, direction_index, output and gradients. Rows are gathered and scattered by the tiles, so that nothing is
// permuted in memory.
#pragma once

#include <cstdint>
#include <vector>

#include "common/isa.h"

namespace voronerf {

enum class Activation : int { none = 0, relu, softplus, sigmoid, sine };

// The operation that errors name.
enum class MlpCaller : int { grouped_mlp = 0, grouped_linear, routed_mlp };

constexpr int kFromPositions = -1;
constexpr int kFromDirections = -2;

// The layer table of voronerf/layers.py; octaves -1: taken as they come.
struct MlpTable {
  struct Layer {
    int64_t width;
    Activation activation;
    std::vector<int> inputs;  // earlier layers, kFromPositions or kFromDirections
  };
  std::vector<Layer> layers;
  std::vector<int> outputs;
  int64_t positions = 0, directions = 0;  // p and q
  int position_octaves = -1, direction_octaves = -1;
  bool integrated = false;  // positions are means and variances, each half of them, encoded as mip-NeRF does
  bool half = false;        // round what enters a product to bfloat16, where the processor multiplies that faster
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
};

// Where gradients go; every element is written. Null: not wanted (weights: all or none; a layer without bias has null).
struct MlpGradients {
  const float* output;  // [n, out], the incoming one
  float* const* weights;
  float* const* biases;
  float* positions;
  float* directions;  // [n,q], or [r,q] summed over each ray's samples in their order
};

// Throws std::invalid_argument for offsets that fall or exceed n and for a direction_index out of range.
void grouped_mlp_cpu(const MlpTable& table, const MlpInputs& inputs, float* out, Isa isa, int threads);

// Activations are computed again, tile by tile, rather than kept since the forward pass.
void grouped_mlp_backward_cpu(const MlpTable& table, const MlpInputs& inputs, const MlpGradients& gradients, Isa isa,
                              int threads);

}  // namespace voronerf
