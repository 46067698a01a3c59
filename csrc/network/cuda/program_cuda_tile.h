// What the kernels of programs share: a call, the rows of its cells, and a tile.
//
// The map from blocks to rows of cells is made on the device, so that the host does not read the offsets. What a caller
// has given and no host has read, offsets, an order and a ray_index, is kept inside the tensors wherever it is used.
#pragma once

#include "common/cuda_wrappers.h"
#include "common/index_maps.h"
#include "encoding/hash_encode_math.h"
#include "network/cuda/program_cuda_product.h"
#include "network/program.h"

namespace voronerf {

constexpr int kProgramMost = 64;  // tensors of a kind: kernel arguments hold 4 KiB
constexpr int kProgramLookups = 16;

struct CudaRows {
  const int32_t *offsets, *order, *ray_index;  // order and ray_index may be null
  int32_t* first_task;                         // [k+1], in the workspace
  int64_t n, r, k;
};

// Pointers of a call, on the device; `code` too.
struct CudaProgram {
  ProgramCode code;
  const HashEncoding* grids;  // without tables
  const ProgramScatter* scatters;
  CudaRows rows;
  float *partials, *spilled;  // in the workspace
  int64_t task_rows;
  const void *inputs[kProgramMost], *parameters[kProgramMost];
  void* outputs[kProgramMost];
  float* sums[kProgramMost];
  int64_t strides[kProgramMost];  // of parameters, from cell to cell
  float* kept[kProgramLookups];   // [n][stride] of each look-up, or null
  int32_t kept_strides[kProgramLookups], output_widths[kProgramMost];
  uint8_t input_types[kProgramMost], parameter_types[kProgramMost], output_types[kProgramMost];
  bool turned[kProgramMost], rays[kProgramMost];  // inputs
  int32_t output_count, lookup_count;
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

// Columns of a value or of a cell's vector.
struct Rows {
  const float* data;
  int stride;
  bool spread;
  __device__ __forceinline__ float at(int row, int column) const { return data[row * stride + (spread ? 0 : column)]; }
};

// Rows of a cell that a block has in hand. A value is [rows][stride] at its slot, rows without a sample included, which
// hold anything.
struct ProgramTile {
  const CudaProgram& call;
  float *slots, *partial;
  int cell, begin;
  int height, rows;  // there are, and have a sample
  bool fill;         // the first tile of a task

  __device__ __forceinline__ float* slot(int32_t columns) const { return slots + columns * height; }
  // Parameters but tables are float32.
  __device__ __forceinline__ const float* parameter(const ProgramPack& pack) const {
    return static_cast<const float*>(call.parameters[pack.parameter]) + cell * call.strides[pack.parameter] +
           pack.start;
  }
  __device__ __forceinline__ Rows operand(const ProgramOperand& o) const {
    if (o.parameter) return {parameter(call.code.packs[o.slot]), 0, o.spread};
    return {slot(o.slot) + o.start, o.stride, o.spread};
  }
};

// visit(row, column) for all entries, by all threads: lanes go along a row as far as it is long.
template <typename Visit>
__device__ __forceinline__ void for_each_entry(int rows, int width, const Visit& visit) {
  const int shift = width > 16 ? 5 : width > 1 ? 32 - __clz(width - 1) : 0;
  const int thread = threadIdx.x, across = 1 << shift;
  for (int row = thread >> shift; row < rows; row += kProgramThreads >> shift) {
    for (int column = thread & (across - 1); column < width; column += across) visit(row, column);
  }
}

}  // namespace voronerf
