// The kernels of programs with bfloat16 products in tile registers, by AMX or, for tests, by its emulation on the
// portable path. Values, slopes, sums and gradients are float32 in the tile, except values that only products read:
// operands of products are rounded to bfloat16.
#include "network/cpu/program_isa.h"

#if VN_ISA == 0 || (VN_ISA == 2 && VN_HAS_TILES)
#if VN_ISA == 2
#pragma GCC target("avx512bf16")
#endif

#define VN_HALF 2
#include "network/cpu/program_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void program_tiles_pack(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free) {
  pack_cell(call, cell, first, packed, free);
}

void program_tiles_run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, const float* packed,
                       float* tiles, float* partial) {
  shape_for(kBlock);
  run_tiles(call, cell, begin, end, packed, tiles, partial);
  release_tiles();
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#endif
