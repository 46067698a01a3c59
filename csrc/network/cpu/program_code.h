// A program as the kernels read it: a header, what is packed for a cell, the steps, and the sums, all of 32-bit
// integers. voronerf/ops/grouped_program/native.py writes them.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// Every value of a tile has a slot of the workspace: [tile][stride], `slot` columns from the start of all slots.
struct ProgramHeader {
  int32_t tile, columns, packed, partial;  // rows of a tile; floats of a row, of a cell's parameters, of the sums
  int32_t packs, steps, sums;              // how many records follow
};

struct ProgramPack {
  // 0: a matrix [o][i] as panels [width][o]; 1: as panels [o][width]; 2: a vector; 4, 5: as 0 and 1, but of up to four
  // outputs, [1 or 4][inputs] for few_outputs_tile.h
  int32_t kind;
  int32_t parameter, o, i, start, width, at;
};

// In the order of voronerf/ops/grouped_program/native.py and of BINARY in voronerf/ops/_core/program.py.
enum {
  kProgramInput,
  kProgramOutput,
  kProgramLinear,
  kProgramFunction,
  kProgramBinary,
  kProgramTotal,
  kProgramMove,
  kProgramOuter,
  kProgramColumns
};
enum { kProgramAdd, kProgramSub, kProgramMul, kProgramDiv, kProgramGate };

struct ProgramOperand {
  int32_t parameter;  // 1: of a vector, whose pack stands in the place of the slot; 0: of a value
  int32_t slot, start, stride, width, spread, place;
};

struct ProgramStep {
  int32_t op, name;
  int32_t order;  // function: of the derivative; linear: 1 or 4 outputs by few_outputs_tile.h, else 0; move: 1 if whole
  int32_t width, slot, stride;
  int32_t number;            // input, output: which; linear: its pack; total: columns of a group; sums: their partial
  int32_t depth;             // linear: of the product; sums: 1 where the inputs are next to each other
  int32_t finish;            // linear: 0, 1 ReLU, 2 where ReLU is 0
  int32_t constants, count;  // of the function; operands, which follow
};

struct ProgramSum {
  int32_t sum, kind;  // kind 0: [inputs][outputs], 1: [outputs][inputs], 2: a vector
  int32_t partial, o, i, start, width, stride, size;
};

// A call of a program on one cell.
struct ProgramCall {
  const int32_t* code;
  const float* constants;
  const float* const* inputs;
  const int32_t* turned;
  int64_t n;
  float* const* outputs;
  float* const* sums;
  const float* const* parameters;
  const int64_t* strides;
  const int32_t* order;
  int64_t tile;  // rows
};

VN_DECLARE_FOR_ISA(void program_pack(const ProgramCall& call, int64_t cell, float* packed))

// Rows [begin, end) of the cell that is packed. `tiles` holds the slots; sums fill `partial`.
VN_DECLARE_FOR_ISA(void program_run(const ProgramCall& call, int64_t begin, int64_t end, const float* packed,
                                    float* tiles, float* partial))

// The sums of a cell, from `count` partials in their order, the first of which is changed.
VN_DECLARE_FOR_ISA(void program_reduce(const ProgramCall& call, int64_t cell, float* partials, int64_t count))

}  // namespace voronerf
