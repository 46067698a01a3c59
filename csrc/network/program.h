// A program of steps on the rows of each cell, with the values of a tile of rows in cache: everything that is done with
// networks of cells. voronerf/ops/_core/program.py says what the steps are. The gradient of a program is a program, so
// there is one function for all derivatives.
//
// n rows, r rays, k cells, w columns. Tensors are contiguous. Rows outside all cells (before offsets[0], from
// offsets[k] on) give 0, and add nothing. Results do not depend on the number of threads.
//
// With `order` [n], the row i that the offsets speak of is row order[i] of inputs and outputs. Rows are gathered and
// scattered by the tiles, so that nothing is permuted in memory.
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
  bool ray;  // [r, w], read by ray_index
};
struct ProgramOutput {
  int32_t width;
  // [r, w], the sum over the samples of each ray, of the rows in the order of the cells. On CUDA its rows, [n, w] in
  // the caller's order, which the caller sums: PyTorch does so without atomics where deterministic algorithms are asked
  // for.
  bool ray;
  int32_t memory;  // of a ray output: of its rows before they are summed; of another one: itself; -1: none
};

// A hash grid at the points of an input, looked up to memory [n][stride] of the call.
struct ProgramLookup {
  int32_t input, parameter, grid, memory;
};
// The gradient of a table, from memory that holds the gradient of what was looked up.
struct ProgramScatter {
  int32_t input, parameter, grid, memory, sum;
};

// What packs and slots are laid out for: products of floats, of pairs of bfloat16, of pairs in tile registers, whose
// tiles are multiples of 32 rows, and on CUDA of any 16-bit numbers; or in tile registers of floats in two parts each,
// as high x high + high x low + low x high.
enum class ProgramLayout : int { floats, pairs, tiles, parts };

// As Python describes a program.
struct ProgramTable {
  std::vector<ProgramPack> packs;
  std::vector<ProgramStep> steps;
  std::vector<ProgramOperand> operands;
  std::vector<ProgramSum> sums;
  std::vector<ProgramInput> inputs;
  std::vector<ProgramOutput> outputs;
  std::vector<int32_t> memories;  // floats of a row of each
  std::vector<ProgramLookup> lookups;
  std::vector<ProgramScatter> scatters;
  std::vector<HashGrid> grids;
  int32_t sum_tensors;  // how many, those of scatters included
  int32_t parameters;   // how many
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

// Tensors of a call. Of each input and parameter: its type, and how it lies.
struct ProgramInputs {
  const void* const* inputs;  // [n, w] or [r, w]; float32 or bfloat16
  std::vector<TableType> input_types;
  std::vector<int32_t> turned;    // it is [w, n], as PyTorch's look-ups in planes give it; float32
  const void* const* parameters;  // [k, ...] or [1, ...]; float32, but tables of hash grids may have 16 bits
  std::vector<TableType> parameter_types;
  std::vector<int64_t> strides;  // entries from one cell's parameter to the next: 0 where all cells share it
  const int32_t* offsets;
  const int32_t* order;      // or null
  const int32_t* ray_index;  // [n], or null without inputs and outputs of rays
  RowCount n, r;
  int64_t k;
  // For each lookup memory [n][stride] of the caller's, filled by the call unless it is `ready`; null entries, or null:
  // what was looked up is not kept.
  float* const* kept;
  bool ready;
  // Rows that are 0 in all inputs from this one on, none of rays, add nothing to any sum; -1: there are none such.
  int64_t gradients;
  const char *caller, *ray_name;  // the operation that errors name, and its name for ray_index
};

struct ProgramResults {
  void* const* outputs;  // of output_types
  std::vector<TableType> output_types;
  float* const* sums;  // [k, ...] each; of a table [tables, entries, features]
};

// Throws std::invalid_argument for offsets that fall or exceed n, for an order that leaves the rows, and for a
// ray_index that names no ray.
void grouped_program_cpu(const Program& program, const ProgramInputs& in, const ProgramResults& results, Isa isa,
                         int threads);

// What products take on CUDA; sums are float32.
enum class ProgramPrecision : int { float32, tf32, bfloat16, float16 };

// Whether a device multiplies 16-bit numbers of this type: before sm_80 there is no bfloat16.
bool multiplies_halves_cuda(ProgramPrecision precision, void* stream);

// The records of a program for the device, and what is there of them: `code` has program_code_bytes(program) bytes, on
// the host; the caller copies it to the device.
int64_t program_code_bytes_cuda(const Program& program);
void program_code_cuda(const Program& program, unsigned char* code);

// Both throw std::invalid_argument for more than 64 tensors of a kind or 16 look-ups. Offsets, an order and a ray_index
// that leave the rows cannot be refused without a host read: they touch nothing outside. Gradients of tables are added
// up by atomics.
int64_t grouped_program_workspace_cuda(const Program& program, int64_t n, int64_t r, int64_t k);
void grouped_program_cuda(const Program& program, const unsigned char* code, const ProgramInputs& in,
                          const ProgramResults& results, ProgramPrecision precision, unsigned char* workspace,
                          void* stream);

}  // namespace voronerf
