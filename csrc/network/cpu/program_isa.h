// The kernels of programs, compiled once per instruction set (program_isa.cpp).
#pragma once

#include "common/isa.h"
#include "encoding/hash_encode_math.h"
#include "network/program_code.h"

namespace voronerf {

// The data of a call that the tiles read.
struct CpuProgram {
  ProgramCode code;
  const void* const* inputs;
  const TableType* input_types;
  const int32_t* input_widths;
  const bool *transposed, *rays, *in_place;  // properties of the inputs
  const void* const* parameters;
  const TableType* parameter_types;
  const int64_t* strides;
  void* const* outputs;
  const TableType* output_types;
  const int32_t* output_widths;
  float* const* sums;
  float* const* memories;     // the call's arrays (program_code.h), in the order of the cells; null: no array
  const bool* filled;         // for each array: it has the results of a finished look-up
  bool looked_up;             // the results of all look-ups in hash grids are filled
  const HashEncoding* grids;  // without the pointers of tables
  const int32_t *order, *ray_index;
  int64_t n;     // rows of inputs
  int64_t tile;  // maximal rows
  bool parts;    // in tile registers: rounding remainders follow the pairs of a value
};

// Packs a cell's parameters. `first`: the cell is the thread's first one. `free`: the thread's slots, as scratch
// memory.
VN_DECLARE_FOR_ISA(void program_pack(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free))

// Runs rows [begin, end) of the packed cell. `tiles` holds the slots, and the sums of the rows are written to
// `partial`.
VN_DECLARE_FOR_ISA(void program_run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end,
                                    const float* packed, float* tiles, float* partial))

// program_pack and program_run with products of bfloat16 pairs.
#if VN_HAS_HALF
namespace avx512 {
void program_half_pack(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free);
void program_half_run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, const float* packed,
                      float* tiles, float* partial);
}  // namespace avx512
#endif

// program_pack and program_run with tile registers, which the portable path emulates.
#define VN_DECLARE_TILES                                                                                        \
  void program_tiles_pack(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free);        \
  void program_tiles_run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, const float* packed, \
                         float* tiles, float* partial);
VN_DECLARE_IN(portable, VN_DECLARE_TILES)
#if VN_HAS_TILES
VN_DECLARE_IN(avx512, VN_DECLARE_TILES)
#endif
#undef VN_DECLARE_TILES

// Computes the sums of a cell from `count` partials, added in order. It overwrites the first partial.
VN_DECLARE_FOR_ISA(void program_reduce(const CpuProgram& call, int64_t cell, float* partials, int64_t count))

}  // namespace voronerf
