// The forward pass of grouped_mlp on CUDA with 16-bit products, values in registers from layer to layer.
//
// A warp takes 32 rows through the network. The sums of two neighbouring 8-column tiles, rounded to 16 bits, are what
// the next layer's step of 16 columns takes as its left operand, so that a layer's value, the held one, never leaves
// the registers that its readers want it in. Where a later layer reads a value that is no longer held, its fragments
// lie in shared memory as well, [step][row tile][lane] of 16 bytes: each lane reads what it wrote. Encodings are
// computed in fragments too. So shared memory moves the weights alone, once for 32 rows, and a tile costs less there
// than on the tensor cores.
//
// Weights are packed in core matrices, 8 outputs by 8 columns in 128 consecutive bytes: four of them, what ldmatrix
// loads at once for 16 outputs by 16 columns, are 512 consecutive bytes, which meet in no bank. A layer's outputs come
// in chunks of 64; a chunk's weights and biases are a piece. A block has all pieces of its cell in shared memory where
// they fit, or two at a time, one that is read and one that is fetched.
//
// This header is the plan, a pure function of the table, the batch and the device, and the order of weights and of
// encoded columns, which kernels and tests share.
#pragma once

#include "common/hd.h"
#include "network/cuda/grouped_mlp_cuda.h"

namespace voronerf {

constexpr int kChainWidest = 128;
constexpr int kChainRows = 32;   // of a warp
constexpr int kChainChunk = 64;  // outputs of a layer at a time
constexpr int kChainStep = 16;   // columns of a step of the product
constexpr int kChainInputTiles = 4;
constexpr int kChainQuad = 512;  // bytes of four core matrices, or of a row tile's fragments for a step

enum class MlpChainFrom : int { held = 0, stored, positions, directions };

struct MlpChainSource {
  MlpChainFrom from;
  int steps;          // of 16 columns
  int region;         // bytes in the warp's region: of a stored value, of an encoding that is kept; else -1
  bool compute;       // an encoding: not there yet, or not kept
  int column, width;  // features of the caller's weight
};

struct MlpChainLayer {
  int index;  // in the caller's table; layers that no output depends on are left out
  int width, inputs, activation;
  int steps;   // of all sources
  int piece;   // bytes in the packed cell
  bool fresh;  // reads an encoding
  bool read;   // by a later layer
  bool held;   // becomes the held value
  bool among;  // the outputs
  int region;  // bytes in the warp's region where the value is stored, -1: it is not
  int source_count;
  MlpChainSource sources[kMlpCudaSources];
};

// An encoded input comes in units of four columns, unit u in lanes with lane % 4 == u % 4: first sine and cosine of two
// consecutive octaves of a feature, unit features * (octave / 2) + feature, then the features themselves by fours.
struct MlpChainInput {
  int raw, octaves, features;
  bool integrated, used;
  int units;   // of octaves
  float last;  // scale of the last octave
  int steps;
};

struct MlpChainPlan {
  MlpPrecision precision;
  int width;  // that the kernel is made for: 32, 64, 128
  int warps;
  bool resident;  // all pieces in shared memory
  int slot;       // bytes of one piece, where they are not
  int weights;    // bytes of shared memory for pieces
  int region;     // bytes of a warp, after them
  int shared_bytes;
  int pieces;  // of a cell
  int64_t packed_bytes;
  int64_t task_rows, tasks;
  int layer_count, output_count, out_features;
  MlpChainInput positions, directions;
  int outputs[kMlpCudaOutputs], output_columns[kMlpCudaOutputs];  // outputs: in `layers`
  MlpChainLayer layers[kMlpCudaLayers];

  int rows() const { return kChainRows * warps; }
};

// Null where the table fits, else the rule that it breaks.
const char* mlp_chain_plan(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k,
                           const MlpCudaDevice& device, MlpChainPlan& plan);

// Bytes of workspace, in MlpCudaWorkspace's order; there are no partials.
MlpCudaWorkspace mlp_chain_workspace(const MlpChainPlan& plan, int64_t k);

void mlp_chain_cuda(const MlpChainPlan& plan, MlpCudaData data, const MlpCudaParameters& parameters,
                    unsigned char* workspace, void* stream);

VN_HD constexpr int chain_chunks(int width) { return (width + kChainChunk - 1) / kChainChunk; }

// 8-column tiles that are multiplied for the outputs of a chunk: 1, 2, 4 or 8; for what reads an encoding 4 or 8, so
// that there is code for encoding in two places alone.
VN_HD constexpr int chain_tiles(int width, int chunk, bool fresh) {
  const int outputs = width - chunk * kChainChunk;
  return outputs > 32 ? 8 : outputs > 16 || fresh ? kChainInputTiles : outputs > 8 ? 2 : 1;
}

// Pairs of tiles that are packed for them.
VN_HD constexpr int chain_pairs(int tiles) { return (tiles + 1) / 2; }

// Bytes of a piece: its weights, then a float of bias for each packed output.
VN_HD constexpr int chain_piece_weights(int steps, int pairs) { return steps * pairs * kChainQuad; }
VN_HD constexpr int chain_piece_bytes(int steps, int pairs) {
  return chain_piece_weights(steps, pairs) + pairs * 16 * 4;
}

// Element of a piece that has the weight of an output of the chunk and a column; and back.
VN_HD constexpr int chain_weight_place(int pairs, int output, int column) {
  const int quad = column / 16 * pairs + output / 16;
  return ((quad * 2 + output / 8 % 2) * 2 + column / 8 % 2) * 64 + output % 8 * 8 + column % 8;
}
VN_HD constexpr int chain_weight_output(int pairs, int place) {
  return place / 256 % pairs * 16 + place / 128 % 2 * 8 + place / 8 % 8;
}
VN_HD constexpr int chain_weight_column(int pairs, int place) {
  return place / 256 / pairs * 16 + place / 64 % 2 * 8 + place % 8;
}

// Feature of the encoding, in the caller's order, that a column of an input holds; -1: none.
VN_HD constexpr int chain_input_feature(const MlpChainInput& input, int column) {
  const int unit = column / 16 * 4 + column % 8 / 2, part = column / 8 % 2 * 2 + column % 2;
  const int before = input.integrated ? 0 : input.raw;
  if (unit >= input.units) {
    const int feature = 4 * (unit - input.units) + part;
    return feature < before ? feature : -1;
  }
  const int octave = unit / input.features * 2 + part / 2;
  if (octave >= input.octaves) return -1;
  return before + (2 * octave + part % 2) * input.features + unit % input.features;
}

// Feature of a source, in the caller's order, that a column of it holds; -1: none.
VN_HD constexpr int chain_source_feature(const MlpChainPlan& plan, const MlpChainSource& source, int column) {
  return source.from == MlpChainFrom::positions    ? chain_input_feature(plan.positions, column)
         : source.from == MlpChainFrom::directions ? chain_input_feature(plan.directions, column)
         : column < source.width                   ? column
                                                   : -1;
}

}  // namespace voronerf
