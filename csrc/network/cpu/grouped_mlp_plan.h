// What the tiles of grouped_mlp do, in plain numbers: which buffer each value lives in, which products and in what
// order. Made once a call from the layer table (grouped_mlp_plan.cpp), read by the kernels of every instruction set; so
// it holds pointers to plain arrays, and no container.
#pragma once

#include <cstdint>

#include "encoding/hash_encode_math.h"
#include "network/grouped_mlp_encoding.h"

namespace voronerf {

constexpr int64_t kGranule = 16;  // columns of every buffer are padded to a multiple of this

// Values of one kind for the rows of a tile: `offset` floats into the workspace, rows of `stride` floats.
struct MlpBuffer {
  int64_t offset, stride;
};

struct MlpPlanSource {
  int from;            // a layer, kFromPositions or kFromDirections
  int64_t width, row;  // its values, and the first input of the layer they are
  bool gradient;       // whether to compute its gradient
  bool first;          // ... as the first contribution to its buffer
  bool last;           // ... as the last one, after which the gradient is complete
  int64_t packed;      // [o][width] in panels, in the workspace
  int64_t packed_row;  // as row, in pairs with bfloat16 operands
  bool by_outputs;  // weight gradient as [o][width, padded] instead of [width][o, padded]: less waste for few outputs
};

struct MlpPlanLayer {
  bool live;  // reaches an output
  int activation;
  int64_t width, padded, depth;  // outputs, padded to kGranule; inputs
  const MlpPlanSource* sources;
  int64_t source_count;
  int64_t packed_depth, packed_width;  // depth and width, in pairs with bfloat16 operands
  int64_t packed, bias;                // weights [depth][padded] in panels, bias [padded], in the workspace
  int64_t dots;  // 1 or 4: outputs are computed as that many dot products, weights packed as [dots][depth]; else 0
  MlpBuffer value, slope, gradient;
  MlpBuffer narrow;               // the value as pairs of bfloat16, stride in pairs
  bool read;                      // by another layer
  bool slope_kept;                // sine: its cosine is kept for the backward pass
  bool slope_fused;               // relu: applied by the product that completes the gradient
  bool from_output;               // part of the network's output
  bool only_output;               // linear and read by no layer: the backward pass needs its gradient, not its value
  int64_t partial, partial_bias;  // gradients [depth][padded] (by_outputs: as said there) and [padded], in a partial
};

struct MlpPlanOutput {
  int layer;
  int64_t column;
};

// Raw features and their encoding.
struct MlpPlanInput {
  int64_t raw, width;
  MlpEncoding encoding;
  bool used, copied;  // copied: values lie in `value`, otherwise they are read where they are
  MlpBuffer staged, value, narrow, gradient;
  int64_t table;         // lanes of the encoding, in the workspace: [3][value.stride] source feature, scale, phase
  bool gradient_wanted;  // of the encoding, for that of the raw features or of a hash grid
};

struct MlpPlan {
  MlpPlanInput positions, directions;
  const MlpPlanLayer* layers;
  int64_t layer_count;
  const MlpPlanOutput* outputs;
  int64_t output_count, out_features;
  int64_t tile;                           // rows
  int64_t workspace;                      // floats a thread needs
  int64_t partial;                        // floats of one partial weight gradient
  int64_t own_partial;                    // a thread's own partial, in its workspace
  int64_t scratch_input, scratch_output;  // bfloat16 operands in other orders; rows of weights while packing
  bool half;                              // bfloat16 operands
  bool gradients;                         // made for the backward pass
  bool parameter_gradients;               // weights and biases wanted
};

// Pointers of one call.
struct MlpData {
  const float* positions = nullptr;
  const float* directions = nullptr;
  const int32_t* direction_index = nullptr;
  const int32_t* order = nullptr;  // the caller's row of each sorted one, or null
  const float* const* weights = nullptr;
  const float* const* biases = nullptr;
  float* out = nullptr;
  const float* grad_out = nullptr;
  float* const* grad_weights = nullptr;
  float* const* grad_biases = nullptr;
  float* grad_positions = nullptr;
  float* grad_directions = nullptr;    // one row a sample; with direction_index in sorted order, to be summed by ray
  const HashEncoding* hash = nullptr;  // of positions that are hashed: the tables of all cells
  // Rows of hashed positions in sorted order, or null: as they are encoded, which the forward pass writes and the
  // backward pass reads; and for the gradient of the hash grid, that of the encoding, and the raw rows.
  float* hashed = nullptr;
  bool encoded = false;  // the forward pass finds them there
  float* hashed_gradient = nullptr;
  float* sorted_positions = nullptr;
};

}  // namespace voronerf
