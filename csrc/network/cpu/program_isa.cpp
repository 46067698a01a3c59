// The CPU kernels of programs, once for each instruction set.
//
// A tile of rows goes through all steps while its values stay in the first two cache levels. A cell's matrices are
// packed once by each thread that works on it, as the products (gemm_tile.h) read them. Sums over rows are added up in
// one partial over all tiles of a task.
#define VN_HALF 0
#include "network/cpu/program_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void program_pack(const ProgramCall& call, int64_t cell, float* packed) {
  const auto& header = *reinterpret_cast<const ProgramHeader*>(call.code);
  const auto* packs = reinterpret_cast<const ProgramPack*>(call.code + sizeof(ProgramHeader) / 4);
  for (int32_t p = 0; p < header.packs; ++p) {
    const ProgramPack& pack = packs[p];
    const float* from = call.parameters[pack.parameter] + cell * call.strides[pack.parameter];
    float* to = packed + pack.at;
    if (pack.kind == 2) {
      const int64_t padded = (pack.width + kGranule - 1) / kGranule * kGranule;
      for (int64_t c = 0; c < padded; ++c) to[c] = c < pack.width ? from[pack.start + c] : 0.0f;
      continue;
    }
    const bool turned = pack.kind % 2 == 1;
    const int64_t outputs = turned ? pack.width : pack.o, depth = turned ? pack.o : pack.width;
    const int64_t padded = (outputs + kGranule - 1) / kGranule * kGranule;
    from += pack.start;
    if (pack.kind > 2) {
      for (int64_t o = 0; o < (outputs == 1 ? 1 : 4); ++o, to += depth) {
        if (o < outputs && !turned) {
          copy_row(from + o * pack.i, depth, to);
        } else {
          for (int64_t i = 0; i < depth; ++i) to[i] = o < outputs ? from[i * pack.i + o] : 0.0f;
        }
      }
      continue;
    }
    for (int64_t first = 0; first < padded; first += kPanel) {
      const int64_t columns = smaller(kPanel, padded - first);
      float* panel = to + first * depth;
      if (turned) {
        const int64_t count = smaller(columns, outputs - first);
        for (int64_t o = 0; o < depth; ++o) {
          const float* row = from + o * pack.i + first;
          for (int64_t c = 0; c < count; ++c) panel[o * columns + c] = row[c];
          for (int64_t c = count; c < columns; ++c) panel[o * columns + c] = 0.0f;
        }
        continue;
      }
      for (int64_t column = 0; column < columns; column += 4) {
        const int64_t o = first + column;
        if (o + 4 <= outputs) {
          transpose_four(from + o * pack.i, pack.i, depth, panel + column, columns);
          continue;
        }
        for (int64_t i = 0; i < depth; ++i) {
          for (int64_t c = 0; c < 4; ++c) {
            panel[i * columns + column + c] = o + c < outputs ? from[(o + c) * pack.i + i] : 0.0f;
          }
        }
      }
    }
  }
}

void program_run(const ProgramCall& call, int64_t begin, int64_t end, const float* packed, float* tiles,
                 float* partial) {
  const auto& header = *reinterpret_cast<const ProgramHeader*>(call.code);
  for (int64_t row = begin; row < end; row += call.tile) {
    ProgramTile{call, header, packed, tiles, partial, row, smaller(call.tile, end - row), row == begin}.run();
  }
}

void program_reduce(const ProgramCall& call, int64_t cell, float* partials, int64_t count) {
  const auto& header = *reinterpret_cast<const ProgramHeader*>(call.code);
  const int32_t* code = call.code + sizeof(ProgramHeader) / 4 + header.packs * sizeof(ProgramPack) / 4;
  for (int32_t i = 0; i < header.steps; ++i) {
    const int32_t operands = reinterpret_cast<const ProgramStep*>(code)->count;
    code += (sizeof(ProgramStep) + operands * sizeof(ProgramOperand)) / 4;
  }
  const auto* sums = reinterpret_cast<const ProgramSum*>(code);
  for (int64_t part = 1; part < count; ++part) {
    const float* next = partials + part * header.partial;
    for (int64_t i = 0; i < header.partial; i += kLanes) store(partials + i, load(partials + i) + load(next + i));
  }
  for (int32_t s = 0; s < header.sums; ++s) {
    const ProgramSum& sum = sums[s];
    float* to = call.sums[sum.sum] + cell * sum.size;
    if (s == 0 || sums[s - 1].sum != sum.sum) {
      for (int64_t i = 0; i < sum.size; ++i) to[i] = 0.0f;
    }
    if (count == 0 || sum.kind < 0) continue;
    const float* from = partials + sum.partial;
    if (sum.kind == 2) {
      for (int64_t c = 0; c < sum.width; ++c) to[sum.start + c] += from[c];
      continue;
    }
    const int64_t by_o = sum.kind == 1 ? sum.stride : 1, by_input = sum.kind == 1 ? 1 : sum.stride;
    for (int64_t o = 0; o < sum.o; ++o) {
      float* row = to + o * sum.i + sum.start;
      for (int64_t c = 0; c < sum.width; ++c) row[c] += from[c * by_input + o * by_o];
    }
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
