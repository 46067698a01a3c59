// A program as the kernels of both devices read it. The structs are plain data: files compiled per instruction set
// include them, and CUDA copies them to the device unchanged. voronerf/ops/network/lowering.py fills the
// records by the names of their members.
//
// A tile is a range of rows of one cell. Each value of a tile has a slot, which begins `slot` columns after the start
// of all slots and has rows of `stride` floats: with T rows in a tile, the value is [T][stride] at tiles + slot * T. A
// value may instead be in an array of the call (`memory`), [n][stride] in the order of the cells: the result of a hash
// grid look-up, its gradient, or an output whose rows are in the order of the cells.
#pragma once

#include <cstdint>

#include "encoding/encodings.h"
#include "network/function_table.h"

namespace voronerf {

constexpr int kGranule = 16;     // columns of every slot are padded to a multiple of this
constexpr int kMostSources = 8;  // operands of a linear step; Python reads this constant
constexpr int kMostHeld = 64;    // columns that a linear step passes on in registers; Python reads this constant

enum class ProgramOp : int { input, output, linear, function, binary, total, move, encode, outer, columns };
enum class ProgramBinary : int { add, sub, mul, div, gate };
enum class ProgramFinish : int { none, relu, relu_slope };
// The result that a linear step leaves in registers for the next one on CUDA. words: its value as pairs. sums:
// accumulators to which the next step adds.
enum class ProgramToRegisters : int { nothing, words, sums };
#define VN_NUMBER(NAME, ...) NAME,
enum class ProgramEncoding : int { VN_ENCODINGS(VN_NUMBER) hash };
enum class ProgramFunction : int { VN_FUNCTIONS(VN_NUMBER) };
#undef VN_NUMBER

// Data that is prepared once per cell, `at` floats from the start:
//   matrix      columns [start, start + width) of a matrix [o][i], as panels [width][o] (gemm_tile.h)
//   transposed  the same as panels [o][width]
//   vector      entries [start, start + width)
//   few, few_transposed  like matrix and transposed, for up to four outputs: [1 or 4][inputs] (few_outputs_tile.h)
//   waves       the table [3][width] of an encoding (frequency_encode_tile.h) with `o` octaves of `i` features,
//               preceded by the features if start is 1; it has no parameter
// waves: on CUDA, the pack of kind `waves` in whose order (WaveOrder) a matrix has its columns, or -1.
enum class ProgramPackKind : int { matrix, transposed, vector, few, few_transposed, waves };
struct ProgramPack {
  ProgramPackKind kind;
  int32_t parameter, o, i, start, width, waves, at;
};

// Columns [start, start + width) of a value or of a parameter vector.
struct ProgramOperand {
  bool parameter;  // the operand is a vector, whose pack has the number `slot`
  bool spread;     // one column is broadcast to all
  int32_t slot, stride;
  int32_t memory;  // array of the call that holds the value, if the call has this array; -1: none
  int32_t input;   // input that may be read in place, if its rows are in the order of the cells; -1: none
  int32_t pairs;   // for 16-bit products: slot of the value as pairs; -1: the product narrows it
  int32_t start, width;
  int32_t place;  // move: first destination column
};

struct ProgramStep {
  ProgramOp op;
  ProgramFunction function;
  ProgramBinary binary;
  ProgramEncoding encoding;
  ProgramFinish finish;  // linear: the activation
  ProgramToRegisters to_registers;
  // function: order of the derivative. linear: the padded number of outputs, 1 or 4, of a step that few_outputs_tile.h
  // computes, else 0. move: 1 if exactly one operand writes each column. encode: 0, or 1 for the gradient of <g, e(x)>
  // with respect to x, with operands x, g, e(x). outer: 1 if the partial sum is [outputs][inputs] of the layer, 0 if it
  // is [inputs][outputs].
  int32_t order;
  int32_t width, slot, stride, memory;  // of the result; memory as in ProgramOperand
  // input, output: its index. linear: index of its pack. total: number of columns that are added to one column of the
  // result. encode: index of its pack of kind `waves`, or of its hash grid. outer, columns: offset in the partial sums.
  int32_t number;
  int32_t depth;                 // linear: depth of the product. output: first destination column. encode: its size
  int32_t sources;               // linear: number of multiplied operands, contiguous in the matrix; on CUDA one
  int32_t parameter;             // encode with a hash grid: the table
  int32_t pairs;                 // for 16-bit products: slot where the value is also stored as pairs; -1: none
  bool floats;                   // with pairs, or a result in registers: whether a step also reads the value as floats
  bool from_registers;           // linear on CUDA: the operand is in registers, left by an earlier step
  bool points;                   // input: only hash grid look-ups read it
  bool in_place;                 // input: it is not copied if it may be read in place
  float a, b;                    // constants of a function
  int32_t first, operand_count;  // index of the first operand, and number of operands
};

// Part of a sum over the rows of a cell, read from its place in the partial. `kind` none: the sum stays 0. waves: the
// order of the partial's inputs, as in ProgramPack.
enum class ProgramSumKind : int { none, inputs_outputs, outputs_inputs, vector };
struct ProgramSum {
  int32_t sum;
  ProgramSumKind kind;
  bool adds;  // adds to a sum that starts at 0; else the parts of the sum do not overlap and overwrite it
  int32_t partial, o, i, start, width, stride, size, waves;
};

// Pointers to all records of a program, in the memory of one device (CPU or CUDA).
struct ProgramCode {
  const ProgramPack* packs;
  const ProgramStep* steps;
  const ProgramOperand* operands;
  const ProgramSum* sums;
  int32_t pack_count, step_count, sum_count;
  int32_t tile;                    // maximal rows
  int32_t columns;                 // columns of all slots of a row
  int32_t packed, partial;         // floats of a cell's packs, and of a task's sums
  int32_t scratch, scratch_width;  // scratch slot of a step, and columns of each of its 2 parts (tile registers: 3)
};

}  // namespace voronerf
