// grouped_linear over threads, task by task (row_tasks.h).
#include "network/grouped_linear.h"

#include <algorithm>

#include "common/common.h"
#include "common/parallel.h"
#include "network/cpu/grouped_linear_isa.h"
#include "network/cpu/row_tasks.h"

namespace voronerf {

namespace {

constexpr RowLimits kRows{96, 2048}, kGradientRows{384, 4096};
constexpr int64_t kTaskUnit = 96;  // whole tiles

void check(const LinearInputs& in) {
  // The products walk their operands with loops that test at the end.
  VN_CHECK(in.i > 0 && in.o > 0, "grouped_linear: a layer must have inputs and outputs");
  check_offsets("grouped_linear", in.offsets, in.k, in.n);
}

int64_t pad(int64_t width, int64_t to) { return ceil_div(width, to) * to; }

LinearCall describe(const LinearInputs& in, const LinearGradients* gradients, Isa isa) {
  LinearCall call{};
  call.x = in.x;
  call.weight = in.weight;
  call.bias = in.bias;
  call.bfloat16 = in.bfloat16;
  call.half = in.bfloat16 && isa == Isa::avx512_bf16;
  const int64_t unit = call.half ? 2 : 1;
  MlpPlanLayer& layer = call.layer;
  layer.activation = static_cast<int>(in.activation);
  layer.width = in.o;
  layer.depth = in.i;
  layer.padded = pad(in.o, kGranule);
  layer.packed_depth = ceil_div(in.i, unit);
  layer.packed_width = ceil_div(in.o, unit);
  layer.slope_kept = in.activation == Activation::sine;
  call.source.width = in.i;
  call.tile = tile_rows();
  call.inputs_padded = pad(in.i, 2 * kGranule);
  call.partial = (in.i + 1) * layer.padded;

  const auto take = [&](int64_t floats) {
    const int64_t at = call.workspace;
    call.workspace += pad(floats, kGranule);
    return at;
  };
  if (in.bfloat16) call.wide = take(in.o * in.i + in.o);
  layer.packed = take(layer.packed_depth * layer.padded);
  layer.bias = take(layer.padded);
  call.input = take(call.tile * call.inputs_padded);
  call.value = take(call.tile * layer.padded);
  // Packing takes four rows of it.
  call.scratch_input = take(std::max(call.tile / 2 * call.inputs_padded, 4 * (layer.packed_depth + kGranule)));
  if (gradients == nullptr) return call;
  call.backward = true;
  call.grad_out = gradients->out;
  call.grad_x = gradients->x;
  call.grad_weight = gradients->weight;
  call.grad_bias = gradients->bias;
  if (!in.bfloat16) call.wide = take(in.o);
  if (layer.slope_kept) layer.slope = {take(call.tile * layer.padded), layer.padded};
  call.slope = layer.slope.offset;
  call.gradient = take(call.tile * layer.padded);
  call.scratch_output = take(call.tile / 2 * layer.padded);
  if (call.grad_x != nullptr) {
    call.source.packed = take(layer.packed_width * pad(in.i, kGranule));
    call.input_gradient = take(call.tile * pad(in.i, kGranule));
  }
  if (call.grad_weight != nullptr) call.own_partial = take(call.partial);
  return call;
}

// Rows of no cell.
void zero_strays(const LinearInputs& in, int64_t width, void* out) {
  const int64_t row = width * (in.bfloat16 ? 2 : 4);
  char* const bytes = static_cast<char*>(out);
  std::fill(bytes, bytes + in.offsets[0] * row, 0);
  std::fill(bytes + in.offsets[in.k] * row, bytes + in.n * row, 0);
}

void pack(Isa isa, const LinearCall& call, int64_t cell, float* own) {
#if VN_HAS_HALF
  if (call.half) return avx512::linear_half_pack(call, cell, own);
#endif
  VN_FOR_ISA(isa, linear_pack(call, cell, own))
}
void forward(Isa isa, const LinearCall& call, const RowTask& task, float* own) {
#if VN_HAS_HALF
  if (call.half) return avx512::linear_half_forward(call, task.begin, task.end, own);
#endif
  VN_FOR_ISA(isa, linear_forward(call, task.begin, task.end, own))
}
void backward(Isa isa, const LinearCall& call, const RowTask& task, float* own, float* partial) {
#if VN_HAS_HALF
  if (call.half) return avx512::linear_half_backward(call, task.begin, task.end, own, partial);
#endif
  VN_FOR_ISA(isa, linear_backward(call, task.begin, task.end, own, partial))
}
void reduce(Isa isa, const LinearCall& call, int64_t cell, float* partials, int64_t count, float* own) {
  VN_FOR_ISA(isa, linear_reduce(call, cell, partials, count, own))
}

template <typename Run>
void run_tasks(const RowTasks& tasks, const LinearCall& call, float* memory, Isa isa, int threads, const Run& run) {
  const auto pack_cell = [&](int64_t cell, float* own, bool) { pack(isa, call, cell, own); };
  for_each_task(tasks, memory, call.workspace, threads, pack_cell, [](int64_t) {}, run);
}

}  // namespace

void grouped_linear_cpu(const LinearInputs& in, void* out, Isa isa, int threads) {
  check(in);
  LinearCall call = describe(in, nullptr, isa);
  call.out = out;
  zero_strays(in, in.o, out);
  const RowTasks tasks = split_rows(in.offsets, in.k, in.n, kRows, kTaskUnit, 0);
  if (tasks.tasks.empty()) return;
  const Workspace workspace(call.workspace * std::max(threads, 1));
  run_tasks(tasks, call, workspace.data(), isa, threads,
            [&](const RowTask& task, float* own) { forward(isa, call, task, own); });
}

void grouped_linear_backward_cpu(const LinearInputs& in, const LinearGradients& gradients, Isa isa, int threads) {
  check(in);
  const LinearCall call = describe(in, &gradients, isa);
  if (gradients.x != nullptr) zero_strays(in, in.i, gradients.x);
  const bool parameters = gradients.weight != nullptr;
  const RowTasks tasks = split_rows(in.offsets, in.k, in.n, kGradientRows, kTaskUnit, call.partial);
  const int64_t partials = parameters ? tasks.first_partial[in.k] : 0, team = std::max(threads, 1);
  const Workspace workspace(call.workspace * team + partials * call.partial);
  float* memory = workspace.data();
  float* partial = memory + call.workspace * team;
  if (!tasks.tasks.empty()) {
    run_tasks(tasks, call, memory, isa, threads, [&](const RowTask& task, float* own) {
      float* to = task.partial < 0 ? own + call.own_partial : partial + task.partial * call.partial;
      backward(isa, call, task, own, to);
      if (task.partial < 0 && parameters) reduce(isa, call, task.cell, to, 1, own);
    });
  }
  if (parameters) {
    Items items(in.k);
    parallel(static_cast<int>(std::min<int64_t>(threads, in.k)), [&](int thread) {
      for (int64_t cell, end; items.take(cell, end);) {
        const int64_t first = tasks.first_partial[cell], count = tasks.partials(cell);
        const bool empty = in.offsets[cell + 1] == in.offsets[cell];
        if (count > 0 || empty) {
          reduce(isa, call, cell, partial + first * call.partial, count, memory + thread * call.workspace);
        }
      }
    });
  }
}

}  // namespace voronerf
