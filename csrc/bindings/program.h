// The structs of programs as Python passes them.
#pragma once

#include "bindings/hash_encode.h"
#include "network/program.h"

namespace voronerf {

VN_NAMES(ProgramOp, "input", "output", "linear", "function", "binary", "total", "move", "encode", "outer", "columns");
VN_NAMES(ProgramBinary, "add", "sub", "mul", "div", "gate");
VN_NAMES(ProgramFinish, "none", "relu", "relu_slope");
VN_NAMES(ProgramToRegisters, "nothing", "words", "sums");
#define VN_NAME(NAME, ...) #NAME,
VN_NAMES(ProgramEncoding, VN_ENCODINGS(VN_NAME) "hash");
VN_NAMES(ProgramFunction, VN_FUNCTIONS(VN_NAME));
#undef VN_NAME
VN_NAMES(ProgramPackKind, "matrix", "transposed", "vector", "few", "few_transposed", "waves");
VN_NAMES(ProgramSumKind, "none", "inputs_outputs", "outputs_inputs", "vector");
VN_NAMES(ProgramLayout, "floats", "pairs", "tiles", "parts");
VN_NAMES(ProgramPrecision, "float32", "tf32", "bfloat16", "float16");
VN_STRUCT(ProgramPack, kind, parameter, o, i, start, width, waves, at);
VN_STRUCT(ProgramOperand, parameter, spread, slot, stride, memory, input, pairs, start, width, place);
VN_STRUCT(ProgramStep, op, function, binary, encoding, finish, to_registers, order, width, slot, stride, memory, number,
          depth, sources, parameter, pairs, floats, from_registers, points, in_place, a, b, first, operand_count);
VN_STRUCT(ProgramSum, sum, kind, adds, partial, o, i, start, width, stride, size, waves);
VN_STRUCT(ProgramInput, width, ray);
VN_STRUCT(ProgramOutput, width, ray, memory);
VN_STRUCT(ProgramLookup, input, parameter, grid, memory);
VN_STRUCT(ProgramScatter, input, parameter, grid, memory, sum);
VN_STRUCT(ProgramTable, packs, steps, operands, sums, inputs, outputs, memories, lookups, scatters, grids, sum_tensors,
          parameters, tile, columns, packed, partial, scratch, scratch_width, layout);
VN_LOADER(ProgramInputs);  // program_call.cpp
VN_STRUCT(ProgramResults, outputs, output_types, sums);
VN_OPAQUE(Program);

}  // namespace voronerf
