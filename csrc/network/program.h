// Programs: sequences of steps on the rows of each cell, such as the layers of its network. The values of a tile of
// rows stay in cache. voronerf/ops/_core/program.py describes the steps. The gradient of a program is a program, so one
// function computes all derivatives.
//
// n rows, r rays, k cells, w columns. Tensors are contiguous. Rows outside all cells (before offsets[0], from
// offsets[k] on) have outputs 0 and add nothing to sums. Results do not depend on the number of threads.
//
// With `order` [n], row i in the order of the cells (the order of `offsets`) is row order[i] of inputs and outputs.
// Each tile gathers and scatters its rows, so no tensor is permuted in memory.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "common/isa.h"
#include "common/row_count.h"
#include "encoding/hash_encode.h"
#include "network/program_code.h"

namespace voronerf {

struct ProgramInput {
  int32_t width;
  bool ray;  // the input is [r, w], indexed by ray_index
};
struct ProgramOutput {
  int32_t width;
  // The output is [r, w], the sum of the rows of each ray's samples, added in the order of the cells. On CUDA the
  // output is the unsummed rows [n, w] in the caller's order, and the caller sums them: with deterministic algorithms,
  // PyTorch sums without atomics.
  bool ray;
  int32_t memory;  // index of the call's array for the unsummed rows if `ray`, else for the output itself; -1: none
};

// A look-up in a hash grid at the points of an input. The result is array number `memory` of the call, [n][stride].
struct ProgramLookup {
  int32_t input, parameter, grid, memory;
};
// The gradient of a table, from array number `memory` of the call, which holds the gradient of the look-up's result.
struct ProgramScatter {
  int32_t input, parameter, grid, memory, sum;
};

// The kind of products for which packs and slots are laid out. floats: float32. pairs: pairs of bfloat16. tiles: pairs
// of bfloat16 in tile registers with tiles of a multiple of 32 rows, or on CUDA any 16-bit numbers. parts: in tile
// registers, with each float split into a high and a low bfloat16 part; a product is computed as high x high + high x
// low + low x high.
enum class ProgramLayout : int { floats, pairs, tiles, parts };

// The description of a program by Python.
struct ProgramTable {
  std::vector<ProgramPack> packs;
  std::vector<ProgramStep> steps;
  std::vector<ProgramOperand> operands;
  std::vector<ProgramSum> sums;
  std::vector<ProgramInput> inputs;
  std::vector<ProgramOutput> outputs;
  std::vector<int32_t> memories;  // floats per row of each array of the call
  std::vector<ProgramLookup> lookups;
  std::vector<ProgramScatter> scatters;
  std::vector<HashGrid> grids;
  int32_t sum_tensors;  // number of sum tensors, including the sums of scatters
  int32_t parameters;   // number of parameters
  int32_t tile, columns, packed, partial, scratch, scratch_width;
  ProgramLayout layout;
};

// A program that is ready to run.
struct Program {
  ProgramTable table;
};
inline std::unique_ptr<Program> make_program(const ProgramTable& table) {
  return std::make_unique<Program>(Program{table});
}

// The input tensors of a call, with the type and layout of each input and parameter.
struct ProgramInputs {
  const void* const* inputs;  // [n, w] or [r, w]; float32 or bfloat16
  std::vector<TableType> input_types;
  std::vector<int32_t> transposed;  // the input is float32 [w, n] in memory, as PyTorch's look-ups in planes return it
  const void* const* parameters;    // [k, ...] or [1, ...]; float32, but tables of hash grids may have 16 bits
  std::vector<TableType> parameter_types;
  std::vector<int64_t> strides;  // entries from one cell's parameter to the next; 0: all cells share it
  const int32_t* offsets;
  const int32_t* order;      // or null
  const int32_t* ray_index;  // [n]; null if no input or output has a row per ray
  RowCount n, r;
  int64_t k;
  // The caller's memory [n][stride] for the result of each lookup, which the call fills unless it is `ready`. Null, or
  // a null entry: the result is not kept.
  float* const* kept;
  bool ready;
  // The index of the first gradient input. All later inputs are gradients too, and none has a row per ray. Rows that
  // are 0 in all gradients add nothing to any sum. -1: no gradients.
  int64_t gradients;
  const char *caller, *ray_name;  // the operation named in errors, and its argument name for ray_index
};

struct ProgramResults {
  void* const* outputs;  // of the types output_types
  std::vector<TableType> output_types;
  float* const* sums;  // [k, ...] each; the sum of a table is [tables, entries, features]
};

// Runs a program on the CPU. Throws std::invalid_argument for offsets that decrease or exceed n, and for entries of
// order or ray_index that are out of range.
void grouped_program_cpu(const Program& program, const ProgramInputs& in, const ProgramResults& results, Isa isa,
                         int threads);

// The types of the operands of products on CUDA; sums are float32.
enum class ProgramPrecision : int { float32, tf32, bfloat16, float16 };

// Returns whether the device multiplies 16-bit numbers of this type: before sm_80 there is no bfloat16.
bool multiplies_halves_cuda(ProgramPrecision precision, void* stream);

// Writes the records of a program for the device to `code`, which has program_code_bytes_cuda(program) bytes on the
// host. The caller copies it to the device.
int64_t program_code_bytes_cuda(const Program& program);
void program_code_cuda(const Program& program, unsigned char* code);

// The first function returns the bytes of the workspace, the second runs a program on CUDA. Both throw
// std::invalid_argument for more than 64 tensors of a kind or 16 look-ups. Out-of-range offsets, order or ray_index
// cannot be rejected without a read by the host, but they never access memory outside the tensors. Gradients of tables
// are added by atomics.
int64_t grouped_program_workspace_cuda(const Program& program, int64_t n, int64_t r, int64_t k);
void grouped_program_cuda(const Program& program, const unsigned char* code, const ProgramInputs& in,
                          const ProgramResults& results, ProgramPrecision precision, unsigned char* workspace,
                          void* stream);

}  // namespace voronerf
