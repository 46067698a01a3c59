// A program of steps on the rows of each cell, with the values of a tile of rows in cache; see
// voronerf/ops/_core/program.py for the steps. The gradient of a program is a program, so there is one function for all
// derivatives.
//
// n rows, k cells, w columns. All tensors are float32 and contiguous. Rows outside all cells (before offsets[0], from
// offsets[k] on) give 0. Results do not depend on the number of threads. With `order` [n], the row i that the offsets
// speak of is row order[i] of inputs and outputs.
#pragma once

#include <cstdint>
#include <vector>

#include "common/isa.h"

namespace voronerf {

struct ProgramInputs {
  const int32_t* code;     // as voronerf/ops/grouped_program/native.py writes it and program_code.h reads it
  const float* constants;  // the numbers of functions
  const float* const* inputs;
  const int32_t* turned;  // for each input: 1 where it is [w, n], as PyTorch's look-ups in planes give it
  const float* const* parameters;
  const int64_t* strides;  // floats from one cell's parameter to the next: 0 where all cells share it
  const int64_t* widths;   // columns of each output
  int64_t outputs;
  const int32_t* offsets;
  const int32_t* order;  // or null
  int64_t n, k;
};

// What the host must know of a program for CUDA.
struct ProgramSizes {
  int64_t columns, partial;                   // of the values of a row; floats of the sums of a task
  int64_t inputs, parameters, outputs, sums;  // how many
};

// Throws std::invalid_argument for offsets that fall or exceed n, and for an order that leaves the rows.
void grouped_program_cpu(const ProgramInputs& in, float* const* outputs, float* const* sums, Isa isa, int threads);

// On CUDA `code` and `constants` are on the device too; strides, turned and widths are not. Both throw
// std::invalid_argument where the values of a few rows do not fit into shared memory.
int64_t grouped_program_workspace_cuda(const ProgramSizes& sizes, int64_t n, int64_t k);
void grouped_program_cuda(const ProgramInputs& in, const ProgramSizes& sizes, float* const* outputs, float* const* sums,
                          unsigned char* workspace, void* stream);

}  // namespace voronerf
