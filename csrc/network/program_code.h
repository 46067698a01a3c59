// A program as the kernels of both devices read it. Plain: files that are compiled once for each instruction set
// include it, and CUDA copies it to the device as it is. voronerf/ops/grouped_program/lowering.py makes the records, by
// the names of their members.
//
// A tile is some rows of one cell. Each value of it has a slot: rows of `stride` floats, `slot` columns from the start
// of all slots, so [tile][stride] at tiles + slot * tile. A value may lie in memory of the whole call instead,
// [n][stride] in the order of the cells, where there is such memory: what hash grids are looked up to, and the gradient
// of that; and an output itself, where its rows lie as those of the tile.
#pragma once

#include <cstdint>

#include "encoding/encodings.h"
#include "network/function_table.h"

namespace voronerf {

constexpr int kGranule = 16;     // columns of every slot are padded to a multiple of this
constexpr int kMostSources = 8;  // of a linear step; Python reads it
constexpr int kMostHeld = 64;    // of a linear step's columns that it hands to the next in registers; Python reads it

enum class ProgramOp : int { input, output, linear, function, binary, total, move, encode, outer, columns };
enum class ProgramBinary : int { add, sub, mul, div, gate };
enum class ProgramFinish : int { none, relu, relu_slope };
// What a linear step has in registers for the next one on CUDA: its value as pairs, or its sums, which that adds to.
enum class ProgramHands : int { nothing, words, sums };
#define VN_NUMBER(NAME, ...) NAME,
enum class ProgramEncoding : int { VN_ENCODINGS(VN_NUMBER) hash };
enum class ProgramFunction : int { VN_FUNCTIONS(VN_NUMBER) };
#undef VN_NUMBER

// What is made ready once for a cell, `at` floats from the start:
//   matrix   columns [start, start + width) of a matrix [o][i], as panels [width][o] (gemm_tile.h)
//   turned   the same as panels [o][width]
//   vector   entries [start, start + width)
//   few, few_turned   as the first two for up to four outputs, [1 or 4][inputs] (few_outputs_tile.h)
//   waves    no parameter: the table of an encoding (frequency_encode_tile.h), `o` octaves of `i` features, which come
//            first themselves if start is 1, [3][width]
enum class ProgramPackKind : int { matrix, turned, vector, few, few_turned, waves };
struct ProgramPack {
  ProgramPackKind kind;
  int32_t parameter, o, i, start, width, at;
};

// Columns [start, start + width) of a value, or of a vector.
struct ProgramOperand {
  bool parameter;  // a vector, whose pack is number `slot`
  bool spread;     // one column in the place of all
  int32_t slot, stride;
  int32_t memory;  // of the call, where the value lies if that memory is there; -1: none
  int32_t input;   // which may be read where it is, if its rows lie as those of the tile; -1: none
  int32_t pairs;   // with 16-bit products: the slot where the value is as pairs; -1: it is to be narrowed
  int32_t start, width;
  int32_t place;  // move: the first column where it goes
};

struct ProgramStep {
  ProgramOp op;
  ProgramFunction function;
  ProgramBinary binary;
  ProgramEncoding encoding;
  ProgramFinish finish;  // of linear
  ProgramHands hands;
  // function: of the derivative. linear: 1 or 4 outputs by few_outputs_tile.h, else 0. move: 1 if every column has one
  // part. encode: 0, or 1 for the gradient to x of <g, e(x)>, with operands x, g, e(x). outer: 1 where the inputs are
  // next to each other in the partial.
  int32_t order;
  int32_t width, slot, stride, memory;  // of what it makes; memory as in ProgramOperand
  // input, output: which. linear: its pack. total: columns of a group. encode: its pack of waves, or the grid. outer,
  // columns: place in the partial.
  int32_t number;
  int32_t depth;         // linear: of the product. output: the first column where it goes. encode: its size
  int32_t sources;       // linear: operands that are multiplied, next to each other in the matrix; on CUDA one
  int32_t parameter;     // encode of a hash grid: the table
  int32_t pairs;         // with 16-bit products: where its value is stored as pairs too; -1: nowhere
  bool floats;           // where there are pairs, or it hands something on: whether anything reads its value as floats
  bool from_registers;   // linear on CUDA: what is multiplied is what a step before has handed on
  bool points;           // input: hash grids alone read it, and nothing does once they are looked up
  bool in_place;         // input: nothing is copied where it may be read in place
  float a, b;            // of a function
  int32_t first, taken;  // operands: the first, and how many
};

// Part of a sum over the rows of a cell, from its place in the partial. `kind` none: nothing is added to that sum.
enum class ProgramSumKind : int { none, inputs_outputs, outputs_inputs, vector };
struct ProgramSum {
  int32_t sum;
  ProgramSumKind kind;
  bool adds;  // to a sum that is 0 before; else the parts of the sum lie side by side, and are written
  int32_t partial, o, i, start, width, stride, size;
};

// All of it, by pointers of one device.
struct ProgramCode {
  const ProgramPack* packs;
  const ProgramStep* steps;
  const ProgramOperand* operands;
  const ProgramSum* sums;
  int32_t pack_count, step_count, sum_count;
  int32_t tile;                    // rows, at most
  int32_t columns;                 // of all slots of a row
  int32_t packed, partial;         // floats of what is made ready for a cell, and of the sums of a task
  int32_t scratch, scratch_width;  // a slot of two parts, in tile registers three, of so many columns, for a step
};

}  // namespace voronerf
