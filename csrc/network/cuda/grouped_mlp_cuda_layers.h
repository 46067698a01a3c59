// How grouped_mlp runs on CUDA where the fused kernel does not fit or would move more memory: one layer after another,
// as grouped products of any width. Sizes, layouts and grids are a pure function of the table, the batch and the
// device.
//
// The batch passes through in slabs of rows, so that what is kept between layers is bounded: every live layer's values
// [rows of a slab][padded width], in the type that is multiplied. A product's block takes 64 rows of one cell, found in
// a map that the device makes for the slab, and 128 columns; depth comes in chunks of 64 bytes through a ring in shared
// memory that is filled asynchronously. Weight gradients take 64 outputs and 128 inputs of a cell, and a part of the
// slab's rows of it; the parts are summed in their order after the last slab, so that they are the same every time.
#pragma once

#include <cstdint>
#include <vector>

#include "network/cuda/grouped_mlp_cuda_chain.h"

namespace voronerf {

constexpr int kLayersRows = 64;        // of a block, of one cell
constexpr int kLayersColumns = 128;    // of a block
constexpr int kLayersParts = 64;       // products that are summed at once: sources of a layer, or its readers
constexpr int kLayersOutputs = 8;      // times that a layer is among the outputs
constexpr int kLayersChunkBytes = 64;  // of the depth in shared memory at a time
constexpr int kLayersStages = 3;       // chunks in the ring

struct MlpLayersSource {
  int from;        // an earlier layer, kFromPositions or kFromDirections
  int64_t width;   // features, columns of the caller's weight from `column` on
  int64_t padded;  // columns of the packed weight from `packed` on
  int64_t column, packed;
};

struct MlpLayersLayer {
  int64_t width, padded, inputs;  // inputs: of the caller's weight
  int activation;
  bool live;
  int64_t stride;        // of the packed weight, [k][padded][stride]
  int64_t weight;        // elements of all packed weights before it, for all cells
  int64_t value, slope;  // columns of a slab's values before it; slope: of a sine's derivative, -1 without
  int64_t partial;       // floats of a cell's partial before it: [padded][stride], then [padded] biases
  std::vector<MlpLayersSource> sources;
  std::vector<int64_t> outputs;  // columns of the network's output
};

struct MlpLayersPlan {
  MlpPrecision precision;
  bool backward;
  int element;                 // bytes
  int64_t slab, slabs, tiles;  // rows of a slab, slabs, and no fewer tiles than a slab's rows can make
  int64_t columns;             // of a slab's values
  int64_t packed;              // elements of packed weights
  int64_t partial;             // floats of a cell's partial
  int multiprocessors;
  int splits;  // parts of a cell's rows in a slab, for weight gradients
  int64_t out_features;
  MlpCudaInput positions, directions;  // value: columns of a slab's values before it
  std::vector<MlpLayersLayer> layers;

  const MlpCudaInput& input(int from) const { return from == kFromPositions ? positions : directions; }
};

// Null if the table fits, else the rule that it breaks.
const char* mlp_layers_plan(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k, bool backward,
                            const MlpCudaDevice& device, MlpLayersPlan& plan);

// Of the ways a call can go the automatic one is the first that takes the table, except where fusing would move more
// than twice the memory; of one that is asked for nothing else is taken.
struct MlpCudaChoice {
  MlpCudaWay way;  // not automatic
  MlpChainPlan chain;
  MlpCudaPlan fused;
  MlpLayersPlan layers;
};
const char* mlp_cuda_choose(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k, bool backward,
                            MlpCudaWay wanted, const MlpCudaDevice& device, MlpCudaChoice& choice);

// A call of a table with its choice.
struct MlpCudaCall {
  MlpTable table;
  MlpCudaChoice choice;
  int64_t workspace;
};

// Whether a table's hash grid is looked up by tiles, forward and backward; else its positions are to be encoded before.
// Tiles take networks of this kind from the chain: those are narrow, and what the chain is faster by (5 ps a sample at
// width 32 by the counts of docs/cuda.md, 33 at 64) is as much as writing and reading 16 features (27 ps of an H200).
bool mlp_cuda_hashes(const MlpTable& table, MlpPrecision precision, MlpCudaWay wanted, const MlpCudaDevice& device);

// Bytes of workspace of a call, and where its parts begin.
struct MlpLayersWorkspace {
  int64_t packed, first_task, values, partials, bytes;
};
MlpLayersWorkspace mlp_layers_workspace(const MlpLayersPlan& plan, int64_t k, bool parameters);

// Parameters of every layer; biases null where there are none. Gradients: null without those of parameters.
struct MlpLayersParameters {
  std::vector<const float*> weights, biases;
};
struct MlpLayersGradients {
  std::vector<float*> weights, biases;
};

void mlp_layers_cuda(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
                     unsigned char* workspace, void* stream);
void mlp_layers_backward_cuda(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
                              const MlpLayersGradients* gradients, unsigned char* workspace, void* stream);

}  // namespace voronerf
