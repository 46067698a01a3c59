// The kernels of programs with bfloat16 products, by the bfloat16 dot product of AVX-512, which multiplies pairs and
// adds to float32. Values, slopes, sums and gradients are float32 in the tile, and operands are rounded to bfloat16 for
// each product (bfloat16_tile.h).
#include "network/cpu/program_isa.h"

#if VN_ISA == 2 && VN_HAS_HALF
#pragma GCC target("avx512bf16")

#define VN_HALF 1
#include "network/cpu/program_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void program_half_pack(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free) {
  pack_cell(call, cell, first, packed, free);
}

void program_half_run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, const float* packed,
                      float* tiles, float* partial) {
  run_tiles(call, cell, begin, end, packed, tiles, partial);
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#endif
