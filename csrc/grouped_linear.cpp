// Tasks of grouped_linear over threads, as those of grouped_mlp: a task is a cell and a range of its rows, which tasks
// there are depends on the sizes alone, and partial gradients are summed in the order of the rows.
#include "grouped_linear.h"

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include "common.h"
#include "grouped_linear_isa.h"
#include "parallel.h"

namespace voronerf {

namespace {

// Rows of a task, in whole tiles: enough to pay for packing the weights, few enough to keep every thread busy.
constexpr int64_t kFewestRows = 96, kMostRows = 2048, kFewestGradientRows = 384, kMostGradientRows = 4096;
constexpr int64_t kTasks = 64;
// Partial gradients of one call, in floats: wide layers get longer tasks instead of more memory.
constexpr int64_t kPartialFloats = int64_t{1} << 24;
constexpr int64_t kAlign = 64;

struct Task {
  int64_t cell, begin, end;
  int64_t partial;  // index of its partial; -1: the cell's only task
};

struct Tasks {
  std::vector<Task> tasks;
  std::vector<int64_t> first_partial;  // [k+1] for each cell
};

struct Free {
  void operator()(float* memory) const { std::free(memory); }
};

// Kept by a thread that has made a call until it ends, since fresh pages are slow; one that large partials have made
// large is given back.
struct Workspace {
  std::unique_ptr<float, Free> memory;
  int64_t size = 0;

  float* grow(int64_t floats) {
    if (floats > size) {
      size = 0;
      memory.reset();
      memory.reset(static_cast<float*>(std::aligned_alloc(kAlign, ceil_div(floats * 4, kAlign) * kAlign)));
      if (memory == nullptr) throw std::bad_alloc();
      size = floats;
    }
    return memory.get();
  }
};
thread_local Workspace kept;

void check(const LinearInputs& in) {
  // The products walk their operands with loops that test at the end.
  VN_CHECK(in.i > 0 && in.o > 0, "grouped_linear: a layer must have inputs and outputs");
  int64_t before = 0;
  for (int64_t c = 0; c <= in.k; ++c) {
    if (in.offsets[c] < before || in.offsets[c] > in.n) {
      throw std::invalid_argument("grouped_linear: offsets must rise from 0 or more to at most the number of rows, " +
                                  std::to_string(in.n) + ", got " + std::to_string(in.offsets[c]) + " for cell " +
                                  std::to_string(c));
    }
    before = in.offsets[c];
  }
}

Tasks split(const LinearInputs& in, int64_t target) {
  Tasks result;
  result.first_partial.assign(in.k + 1, 0);
  int64_t partials = 0;
  for (int64_t c = 0; c < in.k; ++c) {
    const int64_t begin = in.offsets[c], rows = in.offsets[c + 1] - begin;
    const int64_t count = ceil_div(rows, target);
    const int64_t size = count > 1 ? ceil_div(ceil_div(rows, count), kLinearTile) * kLinearTile : rows;
    for (int64_t start = 0; start < rows; start += size) {
      result.tasks.push_back({c, begin + start, begin + std::min(rows, start + size), count > 1 ? partials++ : -1});
    }
    result.first_partial[c + 1] = partials;
  }
  return result;
}

int64_t pad(int64_t width, int64_t to) {
  return ceil_div(width, to) * to;
}

LinearCall describe(const LinearInputs& in, const LinearGradients* gradients, Isa isa) {
  LinearCall call{};
  call.x = in.x;
  call.weight = in.weight;
  call.bias = in.bias;
  call.bfloat16 = in.bfloat16;
  call.half = in.bfloat16 && isa_multiplies_bfloat16(isa);
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
  call.input = take(kLinearTile * call.inputs_padded);
  call.value = take(kLinearTile * layer.padded);
  // Packing takes four rows of it.
  call.scratch_input = take(std::max(kLinearTile / 2 * call.inputs_padded, 4 * (layer.packed_depth + kGranule)));
  if (gradients == nullptr) return call;
  call.backward = true;
  call.grad_out = gradients->out;
  call.grad_x = gradients->x;
  call.grad_weight = gradients->weight;
  call.grad_bias = gradients->bias;
  if (!in.bfloat16) call.wide = take(in.o);
  if (layer.slope_kept) layer.slope = {take(kLinearTile * layer.padded), layer.padded};
  call.slope = layer.slope.offset;
  call.gradient = take(kLinearTile * layer.padded);
  call.scratch_output = take(kLinearTile / 2 * layer.padded);
  if (call.grad_x != nullptr) {
    call.source.packed = take(layer.packed_width * pad(in.i, kGranule));
    call.input_gradient = take(kLinearTile * pad(in.i, kGranule));
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
void forward(Isa isa, const LinearCall& call, const Task& task, float* own) {
#if VN_HAS_HALF
  if (call.half) return avx512::linear_half_forward(call, task.begin, task.end, own);
#endif
  VN_FOR_ISA(isa, linear_forward(call, task.begin, task.end, own))
}
void backward(Isa isa, const LinearCall& call, const Task& task, float* own, float* partial) {
#if VN_HAS_HALF
  if (call.half) return avx512::linear_half_backward(call, task.begin, task.end, own, partial);
#endif
  VN_FOR_ISA(isa, linear_backward(call, task.begin, task.end, own, partial))
}
void reduce(Isa isa, const LinearCall& call, int64_t cell, float* partials, int64_t count, float* own) {
  VN_FOR_ISA(isa, linear_reduce(call, cell, partials, count, own))
}

// run(task, own workspace) for every task, a cell's weights packed.
template <typename Run>
void for_each_task(const Tasks& tasks, const LinearCall& call, float* memory, Isa isa, int threads, const Run& run) {
  const int64_t count = static_cast<int64_t>(tasks.tasks.size());
  Items items(count);
  parallel(static_cast<int>(std::min<int64_t>(threads, count)), [&](int thread) {
    float* own = memory + thread * call.workspace;
    int64_t packed = -1;
    for (int64_t i, end; items.take(i, end);) {
      const Task& task = tasks.tasks[i];
      if (task.cell != packed) pack(isa, call, task.cell, own);
      packed = task.cell;
      run(task, own);
    }
  });
}

}  // namespace

void grouped_linear_cpu(const LinearInputs& in, void* out, Isa isa, int threads) {
  check(in);
  LinearCall call = describe(in, nullptr, isa);
  call.out = out;
  zero_strays(in, in.o, out);
  const Tasks tasks = split(in, std::clamp(in.n / kTasks, kFewestRows, kMostRows));
  if (tasks.tasks.empty()) return;
  float* memory = kept.grow(call.workspace * std::max(threads, 1));
  for_each_task(tasks, call, memory, isa, threads,
                [&](const Task& task, float* own) { forward(isa, call, task, own); });
}

void grouped_linear_backward_cpu(const LinearInputs& in, const LinearGradients& gradients, Isa isa, int threads) {
  check(in);
  const LinearCall call = describe(in, &gradients, isa);
  if (gradients.x != nullptr) zero_strays(in, in.i, gradients.x);
  const bool parameters = gradients.weight != nullptr;
  const int64_t room = std::max<int64_t>(kPartialFloats / call.partial, 1);
  const int64_t target = std::max(std::clamp(in.n / kTasks, kFewestGradientRows, kMostGradientRows), in.n / room);
  const Tasks tasks = split(in, target);
  const int64_t partials = parameters ? tasks.first_partial[in.k] : 0, team = std::max(threads, 1);
  float* memory = kept.grow(call.workspace * team + partials * call.partial);
  float* partial = memory + call.workspace * team;
  if (!tasks.tasks.empty()) {
    for_each_task(tasks, call, memory, isa, threads, [&](const Task& task, float* own) {
      float* to = task.partial < 0 ? own + call.own_partial : partial + task.partial * call.partial;
      backward(isa, call, task, own, to);
      if (task.partial < 0 && parameters) reduce(isa, call, task.cell, to, 1, own);
    });
  }
  if (parameters) {
    Items items(in.k);
    parallel(static_cast<int>(std::min<int64_t>(threads, in.k)), [&](int thread) {
      for (int64_t cell, end; items.take(cell, end);) {
        const int64_t first = tasks.first_partial[cell], count = tasks.first_partial[cell + 1] - first;
        const bool empty = in.offsets[cell + 1] == in.offsets[cell];
        if (count > 0 || empty) {
          reduce(isa, call, cell, partial + first * call.partial, count, memory + thread * call.workspace);
        }
      }
    });
  }
  if (kept.size > 2 * kPartialFloats) kept = Workspace{};
}

}  // namespace voronerf
