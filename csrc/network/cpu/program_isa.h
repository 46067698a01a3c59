// The kernels of programs, once for each instruction set (program_isa.cpp).
#pragma once

#include "common/isa.h"
#include "encoding/hash_encode_math.h"
#include "network/program_code.h"

namespace voronerf {

// What the tiles read of a call.
struct ProgramCall {
  ProgramCode code;
  const void* const* inputs;
  const TableType* input_types;
  const int32_t* input_widths;
  const bool *turned, *rays, *in_place;  // of inputs
  const void* const* parameters;
  const TableType* parameter_types;
  const int64_t* strides;
  void* const* outputs;
  const TableType* output_types;
  const int32_t* output_widths;
  float* const* sums;
  float* const* memories;     // of the call, in the order of the cells, or null
  const bool* filled;         // of memories: nothing is to be looked up
  bool looked_up;             // all memories of hash grids are filled
  const HashEncoding* grids;  // without their tables
  const int32_t *order, *ray_index;
  int64_t n;     // rows of inputs
  int64_t tile;  // rows, at most
  bool parts;    // in tile registers: pairs are followed by what rounding has left of the values
};

// Makes a cell's parameters ready; `first`: nothing was before. `free`: the thread's slots.
VN_DECLARE_FOR_ISA(void program_pack(const ProgramCall& call, int64_t cell, bool first, float* packed, float* free))

// Rows [begin, end) of the cell that is packed. `tiles` holds the slots; sums fill `partial`.
VN_DECLARE_FOR_ISA(void program_run(const ProgramCall& call, int64_t cell, int64_t begin, int64_t end,
                                    const float* packed, float* tiles, float* partial))

// The same with products of bfloat16 pairs.
#if VN_HAS_HALF
namespace avx512 {
void program_half_pack(const ProgramCall& call, int64_t cell, bool first, float* packed, float* free);
void program_half_run(const ProgramCall& call, int64_t cell, int64_t begin, int64_t end, const float* packed,
                      float* tiles, float* partial);
}  // namespace avx512
#endif

// The same in tile registers; on the portable path in their double.
#define VN_DECLARE_TILES                                                                                         \
  void program_tiles_pack(const ProgramCall& call, int64_t cell, bool first, float* packed, float* free);        \
  void program_tiles_run(const ProgramCall& call, int64_t cell, int64_t begin, int64_t end, const float* packed, \
                         float* tiles, float* partial);
VN_DECLARE_IN(portable, VN_DECLARE_TILES)
#if VN_HAS_TILES
VN_DECLARE_IN(avx512, VN_DECLARE_TILES)
#endif
#undef VN_DECLARE_TILES

// The sums of a cell, from `count` partials in their order, the first of which is changed.
VN_DECLARE_FOR_ISA(void program_reduce(const ProgramCall& call, int64_t cell, float* partials, int64_t count))

}  // namespace voronerf
