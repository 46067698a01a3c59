// What the kernels of programs share: a call, the rows of its cells, and a tile.
//
// The map from blocks to rows of cells is made on the device, so that the host does not read the offsets. What a caller
// has given and no host has read, offsets, an order and a ray_index, is kept inside the tensors wherever it is used.
#pragma once

#include "common/cuda_wrappers.h"
#include "common/index_maps.h"
#include "encoding/hash_encode_math.h"
#include "network/program.h"

namespace voronerf {

constexpr int kProgramThreads = 256;
constexpr int kProgramWide = 64;     // columns of a product that a block has at a time
constexpr int kProgramSkew = 4;      // floats that rows of slots are longer than a multiple of 16
constexpr int kProgramOutputs = 32;  // packed weights and biases are 0 up to a multiple of this
constexpr int kProgramMost = 64;     // tensors of a kind: kernel arguments hold 4 KiB
constexpr int kProgramLookups = 16;

struct CudaRows {
  const int32_t *offsets, *order, *ray_index;  // order and ray_index may be null
  int32_t* first_task;                         // [k+1], in the workspace
  int64_t n, r, k;
};

// A value that a product reads: columns from `start` on at a slot.
struct CudaValue {
  int32_t slot, start, stride, columns;
};
// A step as the interpreter reads it, in a few loads: what the step and its operands and packs say, put together. Plain
// steps have `op` and `keeps` alone.
struct alignas(16) CudaStep {
  CudaValue x, y;               // linear: y is where ReLU was. outer: x by y. columns: x
  int32_t slot, stride, pairs;  // of what it makes: as floats, or -1; and where it is as 16-bit words, or -1
  int32_t width, depth;
  int32_t weights, bias, added;  // places in what is packed, and an operand; -1: none
  int32_t partial;               // outer, columns: the place; outer: its rows are `stride` floats
  ProgramOp op;
  bool keeps, relu, sloped, turned;
  bool x_words, y_words, swapped, unused;  // swapped: x is not the gradient
};
static_assert(sizeof(CudaStep) == 80, "five loads");

// All of it at once: a thread waits for none of its numbers by itself.
__device__ __forceinline__ CudaStep load_step(const CudaStep* from) {
  CudaStep step;
  uint4 parts[5];
#pragma unroll
  for (int i = 0; i < 5; ++i) parts[i] = load_constant(reinterpret_cast<const uint4*>(from) + i);
  memcpy(&step, parts, sizeof step);
  return step;
}

// Pointers of a call, on the device; `code` too.
struct CudaProgram {
  ProgramCode code;
  const CudaStep* steps;
  const HashEncoding* grids;  // without tables
  const ProgramScatter* scatters;
  CudaRows rows;
  float *partials, *spilled, *packed;  // in the workspace
  int64_t task_rows, packed_stride;    // of what is packed, from cell to cell
  const void *inputs[kProgramMost], *parameters[kProgramMost];
  void* outputs[kProgramMost];
  float* sums[kProgramMost];
  int64_t strides[kProgramMost];  // of parameters, from cell to cell
  float* kept[kProgramLookups];   // [n][stride] of each look-up, or null
  int32_t kept_strides[kProgramLookups], output_widths[kProgramMost];
  uint8_t input_types[kProgramMost], parameter_types[kProgramMost], output_types[kProgramMost];
  bool turned[kProgramMost], rays[kProgramMost];  // inputs
  int32_t output_count, lookup_count, pack_parts;
  bool ready;  // what is kept is there
};
static_assert(sizeof(CudaProgram) <= 4000, "kernel arguments hold 4 KiB");

// The nearest index in [0, n).
__device__ __forceinline__ int64_t index_within(int64_t index, int64_t n) {
  return index < 0 ? 0 : index < n ? index : n - 1;
}
__device__ __forceinline__ int64_t source_row(const CudaRows& rows, int64_t row) {
  return rows.order == nullptr ? row : index_within(rows.order[row], rows.n);
}

// Rows of a cell.
__device__ __forceinline__ int64_t cell_begin(const CudaRows& rows, int64_t cell) {
  const int64_t first = rows.offsets[cell];
  return first < 0 ? 0 : first > rows.n ? rows.n : first;
}
__device__ __forceinline__ int64_t cell_rows(const CudaRows& rows, int64_t cell) {
  const int64_t count = cell_begin(rows, cell + 1) - cell_begin(rows, cell);
  return count < 0 ? 0 : count;
}

// Numbers by their type in memory.
__device__ __forceinline__ float load_number(const void* from, int type, int64_t at) {
  switch (static_cast<TableType>(type)) {
    case TableType::float32:
      return static_cast<const float*>(from)[at];
    case TableType::bfloat16:
      return unpack_half<true>(static_cast<const uint16_t*>(from)[at]);
    default:
      return unpack_half<false>(static_cast<const uint16_t*>(from)[at]);
  }
}
__device__ __forceinline__ void store_number(void* to, int type, int64_t at, float x) {
  switch (static_cast<TableType>(type)) {
    case TableType::float32:
      static_cast<float*>(to)[at] = x;
      return;
    case TableType::bfloat16:
      static_cast<uint16_t*>(to)[at] = static_cast<uint16_t>(pack_halves<true>(x, 0.0f));
      return;
    default:
      static_cast<uint16_t*>(to)[at] = static_cast<uint16_t>(pack_halves<false>(x, 0.0f));
  }
}

// Column of an input, for a row of the caller's.
__device__ __forceinline__ float load_input(const CudaProgram& call, int input, int width, int64_t source, int column) {
  int64_t row = source, rows = call.rows.n;
  if (call.rays[input]) {
    rows = call.rows.r;
    if (rows == 0) return 0.0f;
    row = index_within(call.rows.ray_index[source], rows);
  }
  return load_number(call.inputs[input], call.input_types[input],
                     call.turned[input] ? column * rows + row : row * width + column);
}

// Of a value as 16-bit numbers: words of a row that are 0 behind its columns, and from row to row.
VN_HD constexpr int padded(int width, int to) { return ceil_div(width, to) * to; }
VN_HD constexpr int pair_words(int width) { return padded(width, 2 * kGranule) / 2; }
VN_HD constexpr int pair_stride(int width) { return pair_words(width) + kProgramSkew; }

// Columns of a value or of a cell's vector.
struct Rows {
  const float* data;
  int stride;
  bool spread;
  __device__ __forceinline__ float at(int row, int column) const { return data[row * stride + (spread ? 0 : column)]; }
};

// What a step makes: floats in a slot, 16-bit numbers in another one, or both.
struct Target {
  float* floats;
  uint16_t* halves;
  int stride, halves_stride;
  bool has_floats, has_halves, bfloat16;
  __device__ __forceinline__ void put(int row, int column, float x) const {
    if (has_floats) floats[row * stride + column] = x;
    if (!has_halves) return;
    const uint32_t word = bfloat16 ? pack_halves<true>(x, 0.0f) : pack_halves<false>(x, 0.0f);
    halves[row * halves_stride + column] = static_cast<uint16_t>(word);
  }
};

// Rows of a cell that a block has in hand. A value is [rows][stride] at its slot, rows without a sample included, which
// hold anything; as 16-bit numbers they are 0. kShared: the slots are the block's shared memory.
template <bool kShared>
struct ProgramTile {
  const CudaProgram& call;
  float *slots, *partial;  // slots: where they are not in shared memory
  const float* weights;    // what is packed for the cell
  int cell, begin;
  int height, rows;       // there are, and have a sample
  bool fill;              // the first tile of a task
  bool halves, bfloat16;  // products are of 16 bits, and which

  __device__ __forceinline__ float* slot(int32_t columns) const {
    if constexpr (kShared) {
      VN_DYN_SHARED(float, shared);
      return shared + columns * height;
    } else {
      return slots + columns * height;
    }
  }
  // Parameters but tables are float32.
  __device__ __forceinline__ const float* parameter(const ProgramPack& pack) const {
    return static_cast<const float*>(call.parameters[pack.parameter]) + cell * call.strides[pack.parameter] +
           pack.start;
  }
  __device__ __forceinline__ const float* packed(int32_t at) const { return weights + at; }
  __device__ __forceinline__ Target target(const ProgramStep& step) const {
    const bool has_halves = step.pairs >= 0;
    auto* halves = reinterpret_cast<uint16_t*>(slot(has_halves ? step.pairs : 0));
    return {slot(step.slot), halves, step.stride, 2 * pair_stride(step.width), step.floats, has_halves, bfloat16};
  }
  __device__ __forceinline__ Rows value(const ProgramOperand& o) const {
    return {slot(o.slot) + o.start, o.stride, o.spread};
  }
  __device__ __forceinline__ Rows operand(const ProgramOperand& o) const {
    if (o.parameter) return {parameter(call.code.packs[o.slot]), 0, o.spread};
    return value(o);
  }
};

// visit(row, column) for all entries, by all threads: lanes go along a row as far as it is long, and a thread down a
// column, so that what depends on the column alone is computed once.
template <typename Visit>
__device__ __forceinline__ void for_each_entry(int rows, int width, const Visit& visit) {
  const int shift = width > 16 ? 5 : width > 1 ? 32 - __clz(width - 1) : 0;
  const int thread = static_cast<int>(thread_again()), across = 1 << shift;
  for (int column = thread & (across - 1); column < width; column += across) {
    for (int row = thread >> shift; row < rows; row += kProgramThreads >> shift) visit(row, column);
  }
}

// partial[j] += sum over rows of a value's column. Four lanes share a column, two neighbouring rows at a time.
template <typename Tile>
__device__ __forceinline__ void sum_columns(const Tile& tile, const CudaStep& step) {
  const Rows x{tile.slot(step.x.slot) + step.x.start, step.x.stride, false};
  const int lane = static_cast<int>(thread_again() % 32);
  for (int first = 8 * static_cast<int>(thread_again() / 32); first < step.width; first += kProgramThreads / 4) {
    const int column = first + lane % 8;
    float sum = 0.0f;
    for (int row = 2 * (lane / 8); row < tile.rows && column < step.width; row += 8) {
      sum += x.at(row, column);
      if (row + 1 < tile.rows) sum += x.at(row + 1, column);
    }
    sum += __shfl_xor_sync(kAllLanes, sum, 8);
    sum += __shfl_xor_sync(kAllLanes, sum, 16);
    if (lane >= 8 || column >= step.width) continue;
    float& entry = tile.partial[step.partial + column];
    entry = (tile.fill ? 0.0f : entry) + sum;
  }
}

// Of 16-bit numbers what no sample has: rows and columns behind the last.
template <typename Tile>
__device__ __forceinline__ void clear_rest(const Tile& tile, const ProgramStep& step) {
  if (step.pairs < 0) return;
  const Target to = tile.target(step);
  const int wide = 2 * pair_words(step.width);
  for_each_entry(tile.height, wide - step.width,
                 [&](int row, int column) { to.halves[row * to.halves_stride + step.width + column] = 0; });
  for_each_entry(tile.height - tile.rows, step.width,
                 [&](int row, int column) { to.halves[(tile.rows + row) * to.halves_stride + column] = 0; });
}

}  // namespace voronerf
