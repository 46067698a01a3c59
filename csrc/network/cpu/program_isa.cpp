// The CPU kernels of programs, compiled once per instruction set.
//
// A tile of rows runs through all steps while its values stay in the first two cache levels, so no [n, layer width]
// tensor is written. Each thread packs the parameters of its cells once, with matrices in the layout of the products
// (gemm_tile.h). All tiles of a task add to the same partial sums, which stay in cache too.
#define VN_HALF 0
#include "network/cpu/program_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void program_pack(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free) {
  pack_cell(call, cell, first, packed, free);
}

void program_run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, const float* packed, float* tiles,
                 float* partial) {
  run_tiles(call, cell, begin, end, packed, tiles, partial);
}

void program_reduce(const CpuProgram& call, int64_t cell, float* partials, int64_t count) {
  const ProgramCode& code = call.code;
  for (int64_t part = 1; part < count; ++part) {
    const float* next = partials + part * code.partial;
    for (int64_t i = 0; i < code.partial; i += kLanes) store(partials + i, load(partials + i) + load(next + i));
  }
  for (int32_t s = 0; s < code.sum_count; ++s) {
    const ProgramSum& sum = code.sums[s];
    float* const to = call.sums[sum.sum] + cell * sum.size;
    const bool first = s == 0 || code.sums[s - 1].sum != sum.sum;
    if (first && (sum.adds || count == 0)) {
      for (int64_t i = 0; i < sum.size; ++i) to[i] = 0.0f;
    }
    if (count == 0 || sum.kind == ProgramSumKind::none) continue;
    const float* from = partials + sum.partial;
    if (sum.kind == ProgramSumKind::vector) {
      for (int64_t c = 0; c < sum.width; ++c) to[sum.start + c] = from[c] + (sum.adds ? to[sum.start + c] : 0.0f);
      continue;
    }
    const bool by_outputs = sum.kind == ProgramSumKind::outputs_inputs;
    const int64_t by_o = by_outputs ? sum.stride : 1, by_input = by_outputs ? 1 : sum.stride;
    int64_t done = 0;
    for (; !sum.adds && !by_outputs && done + 4 <= sum.width; done += 4) {
      transpose_four(from + done * by_input, by_input, sum.o, to + sum.start + done, sum.i);
    }
    for (int64_t o = 0; o < sum.o; ++o) {
      float* const row = to + o * sum.i + sum.start;
      for (int64_t c = done; c < sum.width; ++c) row[c] = from[c * by_input + o * by_o] + (sum.adds ? row[c] : 0.0f);
    }
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
