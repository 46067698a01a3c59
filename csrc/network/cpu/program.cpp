// Programs over threads, task by task (row_tasks.h).
#include "network/program.h"

#include <algorithm>
#include <stdexcept>
#include <string>

#include "common/common.h"
#include "common/parallel.h"
#include "network/cpu/program_code.h"
#include "network/cpu/row_tasks.h"

namespace voronerf {

namespace {

constexpr RowLimits kRows{96, 1024}, kSumRows{384, 4096};
constexpr int64_t kTaskUnit = 48, kGranule = 16, kSlack = 128;

void pack(Isa isa, const ProgramCall& call, int64_t cell, float* packed) {
  VN_FOR_ISA(isa, program_pack(call, cell, packed))
}
void run(Isa isa, const ProgramCall& call, const RowTask& task, const float* packed, float* tiles, float* partial) {
  VN_FOR_ISA(isa, program_run(call, task.begin, task.end, packed, tiles, partial))
}
void reduce(Isa isa, const ProgramCall& call, int64_t cell, float* partials, int64_t count) {
  VN_FOR_ISA(isa, program_reduce(call, cell, partials, count))
}

// Parameters of a cell on their way to the cache, as of grouped_mlp.
void fetch(const ProgramCall& call, int64_t cell) {
  constexpr int64_t kLine = 16, kMostFetched = 1 << 15;  // floats
  const auto& header = *reinterpret_cast<const ProgramHeader*>(call.code);
  if (header.packed > kMostFetched) return;
  const auto* packs = reinterpret_cast<const ProgramPack*>(call.code + sizeof(ProgramHeader) / 4);
  for (int32_t p = 0; p < header.packs; ++p) {
    const int64_t stride = call.strides[packs[p].parameter];
    const float* from = call.parameters[packs[p].parameter] + cell * stride;
    for (int64_t i = 0; i < stride; i += kLine) __builtin_prefetch(from + i, 0, 2);
  }
}

}  // namespace

void grouped_program_cpu(const ProgramInputs& in, float* const* outputs, float* const* sums, Isa isa, int threads) {
  check_offsets("grouped_program", in.offsets, in.k, in.n);
  if (in.order != nullptr) {
    bool beyond = false;  // what is below 0, too, as an unsigned number
    for (int64_t i = 0; i < in.n; ++i) beyond |= static_cast<uint32_t>(in.order[i]) >= static_cast<uint32_t>(in.n);
    if (beyond) {
      const auto [low, high] = std::minmax_element(in.order, in.order + in.n);
      throw std::invalid_argument("grouped_program: order must lie in 0 to " + std::to_string(in.n - 1) +
                                  ", got values from " + std::to_string(*low) + " to " + std::to_string(*high));
    }
  }
  const auto& header = *reinterpret_cast<const ProgramHeader*>(in.code);
  const int64_t tile = std::min<int64_t>(header.tile, tile_rows());
  const ProgramCall call{in.code, in.constants,  in.inputs,  in.turned, in.n, outputs,
                         sums,    in.parameters, in.strides, in.order,  tile};
  const auto clear = [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      for (int64_t o = 0; o < in.outputs; ++o) {
        std::fill_n(outputs[o] + (in.order == nullptr ? i : in.order[i]) * in.widths[o], in.widths[o], 0.0f);
      }
    }
  };
  clear(0, in.offsets[0]);
  clear(in.offsets[in.k], in.n);
  const bool summed = header.sums > 0;
  const RowTasks tasks = split_rows(in.offsets, in.k, in.n, summed ? kSumRows : kRows, kTaskUnit, header.partial);
  const int64_t tiles = header.packed, own_partial = tiles + header.columns * tile + kSlack;
  const int64_t stride = ceil_div(own_partial + header.partial, kGranule) * kGranule;
  const int64_t partials = summed ? tasks.first_partial[in.k] : 0;
  const Workspace workspace(stride * threads + partials * header.partial);
  float* partial = workspace.data() + stride * threads;
  for_each_task(
      tasks, workspace.data(), stride, threads, [&](int64_t cell, float* own, bool) { pack(isa, call, cell, own); },
      [&](int64_t cell) { fetch(call, cell); },
      [&](const RowTask& task, float* own) {
        const bool alone = task.partial < 0;
        float* to = alone ? own + own_partial : partial + task.partial * header.partial;
        run(isa, call, task, own, own + tiles, to);
        if (alone && summed) reduce(isa, call, task.cell, to, 1);
      });
  if (!summed) return;
  parallel_for(in.k, 1, threads, [&](int64_t cell) {
    const int64_t count = tasks.partials(cell);
    const bool empty = in.offsets[cell + 1] == in.offsets[cell];
    if (count > 0 || empty) reduce(isa, call, cell, partial + tasks.first_partial[cell] * header.partial, count);
  });
}

}  // namespace voronerf
