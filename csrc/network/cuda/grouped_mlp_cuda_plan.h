// How grouped_mlp runs on a CUDA device: sizes, layouts and grids as a pure function of the layer table, the batch and
// what a block of the device may have. Plain data, passed to the kernels by value.
//
// A block takes tasks of rows of one cell. Its warps own 16 or 32 rows each, through the whole network: what a warp
// computes no other warp reads, except for weight gradients, so that a layer costs no barrier. A warp's region of
// shared memory holds the network's values, [rows][stride] for each source, in the type that is multiplied; widths are
// padded to 16 columns, which are zero in the weights, and rows by 16 bytes, with which fragments load without bank
// conflicts. The weights are either all in shared memory, or pass through a slot there, 64 outputs at a time.
#pragma once

#include <cstdint>

#include "network/grouped_mlp.h"

namespace voronerf {

constexpr int kMlpCudaLayers = 16;
constexpr int kMlpCudaSources = 4;
constexpr int kMlpCudaOutputs = 8;
constexpr int kMlpChunk = 64;  // outputs of a layer that a warp has in registers
constexpr int kMlpDepth = 16;  // widths are padded to it

struct MlpCudaSource {
  int from;    // an earlier layer, kFromPositions or kFromDirections
  int width;   // features, columns of the caller's weight from `column` on
  int padded;  // columns of the packed weight from `packed` on
  int column, packed;
};

struct MlpCudaLayer {
  int width, padded, activation;
  int inputs;  // of the caller's weight
  bool live;   // some output depends on it
  int source_count;
  int weight, weight_stride;                  // elements in the packed cell, [padded][weight_stride]
  int bias;                                   // floats in the packed cell, after the weights
  int value, stride;                          // elements in the warp's region
  int slope;                                  // the same for the derivative of a sine, -1 without
  int partial, partial_stride, partial_bias;  // floats in a partial gradient, [padded][partial_stride]
  MlpCudaSource sources[kMlpCudaSources];
};

struct MlpCudaInput {
  int raw, octaves, degree;  // octaves: -1 without; degree: of spherical harmonics, 0 without
  int width, padded;
  int value, stride;
  bool integrated, hashed, used;
};

struct MlpCudaPlan {
  MlpPrecision precision;
  bool backward;
  int row_tiles, warps;  // 16-row tiles of a warp, warps of a block
  bool resident;         // the weights of a cell are in shared memory all the time
  int region;            // elements of a warp's region
  int slot;              // elements of shared memory for weights, after the regions
  int shared_bytes;
  int packed_weights, packed_biases;  // elements and floats of a packed cell
  int64_t packed_bytes;               // of a packed cell, a multiple of 16
  int partial;                        // floats of a partial gradient
  int64_t task_rows, tasks;           // rows of a task, and no fewer tasks than there can be
  int layer_count, output_count, out_features;
  MlpCudaInput positions, directions;
  int outputs[kMlpCudaOutputs], output_columns[kMlpCudaOutputs];
  MlpCudaLayer layers[kMlpCudaLayers];

  int rows() const { return 16 * row_tiles * warps; }
};

// What is known of a device.
struct MlpCudaDevice {
  int capability;    // 86 for 8.6; of the architecture that the kernels are compiled for, where that is lower
  int shared_bytes;  // a block may ask for
  int multiprocessors;
  int64_t cache_bytes;  // of the last level
};

// Of features with an encoding, without value, stride and used.
MlpCudaInput mlp_cuda_input(int64_t raw, const MlpEncoding& encoding);

// Fills in what of a plan the table alone says: layers, their sources and widths, which of them are live, inputs and
// outputs. Null, or the rule that the table breaks.
const char* mlp_cuda_read_table(const MlpTable& table, MlpCudaPlan& plan);

// Null where the table fits, else the rule that it breaks. The plan of a table that does not fit is undefined.
const char* mlp_cuda_plan(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k, bool backward,
                          const MlpCudaDevice& device, MlpCudaPlan& plan);

// Warps that a multiprocessor has at a time, of a plan with its shape.
int mlp_cuda_warps(const MlpCudaPlan& plan, const MlpCudaDevice& device);

// Bytes of workspace of a call, and where its parts begin: packed cells, first task of every cell [k+1], partials.
struct MlpCudaWorkspace {
  int64_t packed, first_task, partials, bytes;
};
MlpCudaWorkspace mlp_cuda_workspace(const MlpCudaPlan& plan, int64_t k, bool parameters);

}  // namespace voronerf
