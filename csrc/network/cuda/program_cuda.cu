// Programs on CUDA: an interpreter. A block takes tasks, rows of one cell, and all of its threads do one step after
// another for a tile of rows.
//
// Values lie in shared memory as float32, each [rows][stride] at its slot, 64 rows where two blocks of that fit into a
// multiprocessor, else 32; what does not fit with 32 lies in the workspace instead, a part for each of two blocks a
// multiprocessor, which the second-level cache holds. Rows are 4 floats longer than a multiple of 16, so that the lanes
// of a product are in different banks (program_cuda_product.h).
//
// Layers: weights come from where they lie, through a strip of shared memory, 32 inputs of 64 outputs at a time; those
// of the next strip are on their way in registers while one is multiplied. Sums over rows: a thread has the same
// entries in every tile and adds to them in the task's partial in global memory; a second kernel adds up the partials
// of a cell in their order, so results are the same every time. Gradients of tables alone are added up by atomic
// operations, in any order.
//
// Budget: 256 threads of up to 128 registers, 16 of which are sums of a product, so that two blocks are resident. What
// is not a product is not inlined, so that it is compiled once for all kernels. With 32 rows one register is spilled on
// sm_86 and sm_89, once written and once read.
#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>

#include "network/cuda/program_cuda_encoding.h"
#include "network/program.h"

#define VN_ISA_NAMESPACE device
#define VN_INLINE __device__ __forceinline__

namespace voronerf {
namespace device {
namespace {

// What the functions are made of, for one float.
using F32 = float;
VN_INLINE float splat(float x) { return x; }
VN_INLINE float fma(float a, float b, float c) { return fmaf(a, b, c); }
VN_INLINE float abs(float x) { return fabsf(x); }
VN_INLINE float any_exponential(float x) { return expf(x); }
VN_INLINE float exponential_minus_one(float x) { return expm1f(x); }
VN_INLINE float softplus(float x) { return (x > 0.0f ? x : 0.0f) + log1pf(expf(-fabsf(x))); }
VN_INLINE float any_sine(float angle, bool cosine) { return cosine ? cosf(angle) : sinf(angle); }
VN_INLINE float logarithm(float x) { return logf(x); }
VN_INLINE float square_root(float x) { return sqrtf(x); }
VN_INLINE float rounded_down(float x) { return floorf(x); }

}  // namespace
}  // namespace device
}  // namespace voronerf

#undef VN_INLINE
#define VN_INLINE static __device__ __forceinline__
#include "network/functions.h"

namespace voronerf {

namespace {

constexpr int kThreads = kProgramThreads;
constexpr int64_t kTaskRows = 128, kTasksPerMultiprocessor = 4, kPartialBytes = int64_t{1} << 28;
constexpr int64_t kBlocksPerMultiprocessor = 8;  // of kernels other than the interpreter
constexpr int kResident = 2;                     // blocks of the interpreter on a multiprocessor
constexpr int kStripBytes = 4 * kProgramStrip;
// The memory of a step, in the device's records: the number of a look-up, none, or below that the number of a scatter.
constexpr int kNoMemory = -1;

// Steps ----------------------------------------------------------------------------------------------------------

template <typename Function>
__device__ __forceinline__ float derivative(int order, float x, float a, float b) {
  switch (order) {
    case 0:
      return Function::template at<0>(x, a, b);
    case 1:
      return Function::template at<1>(x, a, b);
    case 2:
      return Function::template at<2>(x, a, b);
    default:
      return Function::template at<3>(x, a, b);
  }
}

__device__ __noinline__ void function_step(const ProgramTile& tile, const ProgramStep& step,
                                           const ProgramOperand* operands) {
  const Rows x = tile.operand(operands[0]), times = tile.operand(operands[step.taken - 1]);
  const float a = step.a, b = step.b;
  const int order = step.order, stride = step.stride;
  const bool alone = step.taken == 1;
  float* const to = tile.slot(step.slot);
  switch (step.function) {
#define VN_CASE(NAME, ...)                                                                                  \
  case ProgramFunction::NAME:                                                                               \
    return for_each_entry(tile.rows, step.width, [&](int row, int column) {                                 \
      const float by = alone ? 1.0f : times.at(row, column);                                                \
      to[row * stride + column] = by * derivative<device::NAME##_function>(order, x.at(row, column), a, b); \
    });
    VN_FUNCTIONS(VN_CASE)
#undef VN_CASE
  }
}

__device__ __forceinline__ float binary(ProgramBinary name, float a, float b) {
  switch (name) {
    case ProgramBinary::add:
      return a + b;
    case ProgramBinary::sub:
      return a - b;
    case ProgramBinary::mul:
      return a * b;
    case ProgramBinary::div:
      return a / b;
    default:
      return b == 0.0f ? 0.0f : a;
  }
}

__device__ __forceinline__ void move_step(const ProgramTile& tile, const ProgramStep& step,
                                          const ProgramOperand* operands) {
  float* const to = tile.slot(step.slot);
  const int stride = step.stride;
  if (step.order == 1) {  // every column has one part
    for (int i = 0; i < step.taken; ++i) {
      const Rows x = tile.operand(operands[i]);
      const int place = operands[i].place;
      for_each_entry(tile.rows, operands[i].width,
                     [&](int row, int column) { to[row * stride + place + column] = x.at(row, column); });
    }
    return;
  }
  for_each_entry(tile.rows, step.width, [&](int row, int column) {
    float sum = 0.0f;
    for (int i = 0; i < step.taken; ++i) {
      const int within = column - operands[i].place;
      if (within >= 0 && within < operands[i].width) sum += tile.operand(operands[i]).at(row, within);
    }
    to[row * stride + column] = sum;
  });
}

__device__ __forceinline__ void input_step(const ProgramTile& tile, const ProgramStep& step) {
  const CudaProgram& call = tile.call;
  float* const to = tile.slot(step.slot);
  const int input = step.number, width = step.width, stride = step.stride;
  const bool turned = call.turned[input];  // neighbouring lanes read neighbouring rows, else columns
  for_each_entry(turned ? width : tile.rows, turned ? tile.rows : width, [&](int i, int j) {
    const int row = turned ? j : i, column = turned ? i : j;
    to[row * stride + column] = load_input(call, input, width, source_row(call.rows, tile.begin + row), column);
  });
}

__device__ __forceinline__ void output_step(const ProgramTile& tile, const ProgramStep& step,
                                            const ProgramOperand* operands) {
  const CudaProgram& call = tile.call;
  const Rows x = tile.operand(operands[0]);
  const int output = step.number, type = call.output_types[output];
  for_each_entry(tile.rows, step.width, [&](int row, int column) {
    const int64_t at = source_row(call.rows, tile.begin + row) * call.output_widths[output] + step.depth + column;
    store_number(call.outputs[output], type, at, x.at(row, column));
  });
}

// Steps that multiply nothing.
__device__ __noinline__ void plain_step(const ProgramTile& tile, const ProgramStep& given) {
  const ProgramStep step = given;
  const ProgramOperand* operands = tile.call.code.operands + step.first;
  float* const to = tile.slot(step.slot);
  switch (step.op) {
    case ProgramOp::input:
      return input_step(tile, step);
    case ProgramOp::output:
      return output_step(tile, step, operands);
    case ProgramOp::function:
      return function_step(tile, given, operands);
    case ProgramOp::binary: {
      const Rows x = tile.operand(operands[0]), y = tile.operand(operands[1]);
      return for_each_entry(tile.rows, step.width, [&](int row, int column) {
        to[row * step.stride + column] = binary(step.binary, x.at(row, column), y.at(row, column));
      });
    }
    case ProgramOp::total: {
      const Rows x = tile.operand(operands[0]);
      return for_each_entry(tile.rows, step.width, [&](int row, int column) {
        float sum = 0.0f;
        for (int i = 0; i < step.number; ++i) sum += x.at(row, column * step.number + i);
        to[row * step.stride + column] = sum;
      });
    }
    case ProgramOp::move:
      return move_step(tile, step, operands);
    case ProgramOp::encode: {
      const bool there = tile.call.ready && step.memory >= 0 && tile.call.kept[step.memory] != nullptr;
      if (!there) return encode_step(tile, given, operands);
      const int64_t stride = tile.call.kept_strides[step.memory];
      const float* from = tile.call.kept[step.memory] + tile.begin * stride;
      return for_each_entry(tile.rows, step.width,
                            [&](int row, int column) { to[row * step.stride + column] = from[row * stride + column]; });
    }
    default: {  // columns
      const Rows x = tile.operand(operands[0]);
      for (int column = threadIdx.x; column < step.width; column += kThreads) {
        float sum = tile.fill ? 0.0f : tile.partial[step.number + column];
        for (int row = 0; row < tile.rows; ++row) sum += x.at(row, column);
        tile.partial[step.number + column] = sum;
      }
    }
  }
}

// What becomes of a value beside its slot: what was looked up is kept, and the gradient of that is added to that of the
// table.
__device__ __noinline__ void keep(const ProgramTile& tile, const ProgramStep& step) {
  const CudaProgram& call = tile.call;
  if (step.memory < kNoMemory) return scatter_rows(tile, step, call.scatters[kNoMemory - 1 - step.memory]);
  if (call.kept[step.memory] == nullptr || call.ready) return;
  const int64_t stride = call.kept_strides[step.memory];
  float* const to = call.kept[step.memory] + tile.begin * stride;
  const float* from = tile.slot(step.slot);
  for_each_entry(tile.rows, static_cast<int>(stride), [&](int row, int column) {
    to[row * stride + column] = column < step.width ? from[row * step.stride + column] : 0.0f;
  });
}

// A product. Rows without a sample get what lies in the slots, and are not stored.
//
// What enters a product of float16 is cut off at its largest number, since infinities in a network soon become NaN,
// except for gradients: whoever scales a loss looks for the infinite ones. What a turned matrix multiplies is taken for
// one.
template <typename Products>
__device__ __forceinline__ void linear_step(const ProgramTile& tile, float* slots, float* strip,
                                            const ProgramStep& step) {
  const ProgramOperand* operands = tile.call.code.operands + step.first;
  const ProgramPack pack = tile.call.code.packs[step.number];
  const bool turned = pack.kind == ProgramPackKind::turned || pack.kind == ProgramPackKind::few_turned;
  const bool sloped = step.finish == ProgramFinish::relu_slope, added = step.taken > 1 + sloped;
  const float* weights = tile.parameter(pack);
  const Rows add = added ? tile.operand(operands[1]) : Rows{};
  const Rows slope = sloped ? tile.operand(operands[step.taken - 1]) : Rows{};
  const float largest = turned ? __builtin_inff() : kLargestHalf;
  ByRows x{slots + operands[0].slot * tile.height + operands[0].start, operands[0].stride, largest};
  float* const to = slots + step.slot * tile.height;
  constexpr int kTurns = kProgramDepth * kProgramWide / kThreads;
  for (int first = 0; first < step.width; first += kProgramWide) {
    const int columns = step.width - first < kProgramWide ? step.width - first : kProgramWide;
    typename Products::Sums sums;
#pragma unroll
    for (int i = 0; i < Products::kSums; ++i) {
      const MapPlace at = Products::place(i);
      const bool there = added && at.row < tile.rows && at.column < columns;
      Products::sum(sums, i) = there ? add.at(at.row, first + at.column) : 0.0f;
    }
    // The part of the strip that a thread loads in its turns, along the rows of memory.
    const auto place = [&](int turn) {
      const int entry = thread_again() + turn * kThreads;
      return turned ? MapPlace{entry / kProgramWide, entry % kProgramWide}
                    : MapPlace{entry % kProgramDepth, entry / kProgramDepth};
    };
    float ahead[kTurns];
    const auto fetch = [&](int start) {
#pragma unroll
      for (int turn = 0; turn < kTurns; ++turn) {
        const MapPlace at = place(turn);
        const int input = start + at.row, output = first + at.column;
        const bool there = input < step.depth && at.column < columns;
        ahead[turn] = there ? weights[turned ? input * pack.i + output : output * pack.i + input] : 0.0f;
      }
    };
    fetch(0);
    for (int start = 0; start < step.depth; start += kProgramDepth) {
      const int deep = step.depth - start < kProgramDepth ? step.depth - start : kProgramDepth;
#pragma unroll
      for (int turn = 0; turn < kTurns; ++turn) {
        const MapPlace at = place(turn);
        Products::store(strip, at.column, at.row, ahead[turn]);
      }
      __syncthreads();
      if (start + kProgramDepth < step.depth) fetch(start + kProgramDepth);
      const ByRows part{x.data + start, x.stride, x.largest};
      Products::multiply(sums, part, Products::strip(strip), deep, columns);
      __syncthreads();  // the strip has been read
    }
#pragma unroll
    for (int i = 0; i < Products::kSums; ++i) {
      const MapPlace at = Products::place(i);
      if (at.row >= tile.rows || at.column >= columns) continue;
      float value = Products::sum(sums, i);  // comparisons keep NaN
      if (step.finish == ProgramFinish::relu) value = value < 0.0f ? 0.0f : value;
      if (sloped) value = slope.at(at.row, first + at.column) <= 0.0f ? 0.0f : value;
      to[at.row * step.stride + first + at.column] = value;
    }
  }
}

// partial[i][j] += sum over rows of a[row][i] b[row][j].
template <typename Products, int kHeight>
__device__ __forceinline__ void outer_step(const ProgramTile& tile, const float* slots, const ProgramStep& step) {
  const ProgramOperand* operands = tile.call.code.operands + step.first;
  const auto columns = [&](int number) {
    const ProgramOperand& o = operands[number];
    return ByColumns{slots + o.slot * tile.height + o.start, o.stride, number == 0 ? __builtin_inff() : kLargestHalf,
                     o.width};
  };
  const ByColumns all_a = columns(step.order == 1 ? 0 : 1), all_b = columns(step.order == 1 ? 1 : 0);
  for (int i0 = 0; i0 < all_a.count; i0 += kHeight) {
    for (int j0 = 0; j0 < all_b.count; j0 += kProgramWide) {
      const ByColumns a{all_a.data + i0, all_a.stride, all_a.largest, all_a.count - i0};
      const ByColumns b{all_b.data + j0, all_b.stride, all_b.largest, all_b.count - j0};
      typename Products::Sums sums = {};
      Products::multiply(sums, a, b, tile.rows, b.count);
#pragma unroll
      for (int i = 0; i < Products::kSums; ++i) {
        const MapPlace at = Products::place(i);
        if (at.row >= a.count || at.column >= b.count) continue;
        float& entry = tile.partial[step.number + (i0 + at.row) * step.stride + j0 + at.column];
        entry = (tile.fill ? 0.0f : entry) + Products::sum(sums, i);
      }
    }
  }
}

// Kernels --------------------------------------------------------------------------------------------------------

// kSpilled: values lie in the workspace.
template <typename Products, int kHeight, bool kSpilled>
__global__ void __launch_bounds__(kThreads, kResident)
    program_kernel(const VN_GRID_CONSTANT CudaProgram call, int64_t partial) {
  VN_DYN_SHARED(float, shared);
  float* slots = shared + kProgramStrip;
  if constexpr (kSpilled) slots = call.spilled + int64_t{blockIdx.x} * call.code.columns * kHeight;
  const CudaRows& rows = call.rows;
  const int tasks = rows.first_task[rows.k];
  for (int task = blockIdx.x; task < tasks; task += gridDim.x) {
    const int cell = static_cast<int>(last_not_above(rows.first_task, rows.k, task));
    const int64_t first = cell_begin(rows, cell), last = first + cell_rows(rows, cell);
    const int64_t begin = first + (task - rows.first_task[cell]) * call.task_rows;
    const int count = static_cast<int>(last - begin < call.task_rows ? last - begin : call.task_rows);
    for (int done = 0; done < count; done += kHeight) {
      const int left = count - done < kHeight ? count - done : kHeight, row = static_cast<int>(begin) + done;
      const ProgramTile tile{call, slots, call.partials + task * partial, cell, row, kHeight, left, done == 0};
      for (int i = 0; i < call.code.step_count; ++i) {
        const ProgramStep& step = call.code.steps[i];
        if (step.op == ProgramOp::linear) {
          linear_step<Products>(tile, slots, shared, step);
        } else if (step.op == ProgramOp::outer) {
          outer_step<Products, kHeight>(tile, slots, step);
        } else {
          plain_step(tile, step);
        }
        __syncthreads();
        if (step.memory != kNoMemory) {
          keep(tile, step);
          __syncthreads();
        }
      }
    }
  }
}

// first_task [k+1] by one block: the running sum of the tasks of the cells. Cells that overlap, which offsets that
// fall make, could have more tasks than `most`, what the workspace has partials for: no number exceeds it, and what
// such cells get is undefined.
__device__ void number_tasks(const CudaRows& rows, int64_t task_rows, int64_t most) {
  VN_SHARED(sums, int64_t[kThreads / 32]);
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const auto inside = [most](int64_t tasks) { return static_cast<int32_t>(tasks < most ? tasks : most); };
  int64_t carry = 0;
  for (int64_t start = 0; start < rows.k; start += kThreads) {
    const int64_t cell = start + threadIdx.x;
    const int64_t tasks = cell < rows.k ? ceil_div(cell_rows(rows, cell), task_rows) : 0;
    int64_t running = tasks;
    for (int step = 1; step < 32; step *= 2) {
      const int64_t other = __shfl_up_sync(kAllLanes, running, step);
      if (lane >= step) running += other;
    }
    if (lane == 31) sums[warp] = running;
    __syncthreads();
    int64_t before = carry;
    for (int i = 0; i < kThreads / 32; ++i) {
      if (i < warp) before += sums[i];
      carry += sums[i];
    }
    if (cell < rows.k) rows.first_task[cell] = inside(before + running - tasks);
    __syncthreads();  // the sums are read by all
  }
  if (threadIdx.x == 0) rows.first_task[rows.k] = inside(carry);
}

// The first block numbers the tasks, and all clear what rows of no cell have: outputs, and what is kept of them.
__global__ void __launch_bounds__(kThreads)
    program_prepare_kernel(const VN_GRID_CONSTANT CudaProgram call, int64_t most) {
  const CudaRows& rows = call.rows;
  if (blockIdx.x == 0) number_tasks(rows, call.task_rows, most);
  const int64_t low = cell_begin(rows, 0), last = cell_begin(rows, rows.k), high = last < low ? low : last;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < rows.n - (high - low); i += step) {
    const int64_t stray = i < low ? i : i + high - low, row = source_row(rows, stray);
    for (int o = 0; o < call.output_count; ++o) {
      const int width = call.output_widths[o];
      for (int c = 0; c < width; ++c) store_number(call.outputs[o], call.output_types[o], row * width + c, 0.0f);
    }
    for (int l = 0; l < call.lookup_count; ++l) {
      const int64_t stride = call.kept_strides[l];
      if (call.kept[l] == nullptr || call.ready) continue;
      for (int c = 0; c < stride; ++c) call.kept[l][stray * stride + c] = 0.0f;
    }
  }
}

// Grid (k, blocks of a cell).
__global__ void __launch_bounds__(kThreads)
    program_reduce_kernel(const VN_GRID_CONSTANT CudaProgram call, int64_t partial) {
  const ProgramCode& code = call.code;
  const int64_t cell = blockIdx.x, first = call.rows.first_task[cell], last = call.rows.first_task[cell + 1];
  for (int s = 0, next; s < code.sum_count; s = next) {
    for (next = s + 1; next < code.sum_count && code.sums[next].sum == code.sums[s].sum;) ++next;
    const int size = code.sums[s].size;
    for (int i = static_cast<int>(blockIdx.y * kThreads + threadIdx.x); i < size; i += gridDim.y * kThreads) {
      float total = 0.0f;
      for (int r = s; r < next; ++r) {
        const ProgramSum& sum = code.sums[r];
        if (sum.kind == ProgramSumKind::none) continue;
        const bool vector = sum.kind == ProgramSumKind::vector, turned = sum.kind == ProgramSumKind::inputs_outputs;
        const int o = vector ? 0 : i / sum.i, column = i - o * sum.i * !vector - sum.start;
        if (column < 0 || column >= sum.width) continue;
        const int at = sum.partial + (turned ? column * sum.stride + o : o * sum.stride + column);
        for (int64_t task = first; task < last; ++task) total += call.partials[task * partial + at];
      }
      call.sums[code.sums[s].sum][cell * size + i] = total;
    }
  }
}

// Launches -------------------------------------------------------------------------------------------------------

struct Device {
  int multiprocessors, shared_bytes;
  int capability;  // 86 for 8.6; of the architecture that the kernels are compiled for, where that is lower
};

// Of the current device, which each thread asks for once.
const Device& current_device() {
  thread_local int asked = -1;
  thread_local Device found{};
  int device = 0;
  VN_CUDA_CHECK(cudaGetDevice(&device));
  if (asked == device) return found;
  int major = 0, minor = 0;
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&found.shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&found.multiprocessors, cudaDevAttrMultiProcessorCount, device));
  // Code for a lower architecture than the device's chooses its instructions by that.
  cudaFuncAttributes compiled{};
  VN_CUDA_CHECK(cudaFuncGetAttributes(&compiled, program_prepare_kernel));
  found.capability = std::min(10 * major + minor, compiled.ptxVersion);
  asked = device;
  return found;
}

// Where the slots of a program are in shared memory, whose rows are longer than the program says: a slot moves by what
// those before it have grown. A value that a program has in memory alone, the gradient of what was looked up, has a
// slot here instead, behind the others.
class Slots {
 public:
  explicit Slots(const ProgramTable& table) : own_(table.memories.size(), -1) {
    for (const ProgramStep& step : table.steps) {
      if (makes_value(step)) starts_.push_back(step.slot);
    }
    std::sort(starts_.begin(), starts_.end());
    starts_.erase(std::unique(starts_.begin(), starts_.end()), starts_.end());
    columns_ = table.columns + kProgramSkew * static_cast<int32_t>(starts_.size());
    for (const ProgramScatter& scatter : table.scatters) {
      own_[static_cast<size_t>(scatter.memory)] = columns_;
      columns_ += table.memories[static_cast<size_t>(scatter.memory)] + kProgramSkew;
    }
  }
  static bool makes_value(const ProgramStep& step) {
    return step.op != ProgramOp::output && step.op != ProgramOp::outer && step.op != ProgramOp::columns;
  }
  int32_t at(int32_t slot, int32_t memory) const {
    if (memory >= 0 && own_[static_cast<size_t>(memory)] >= 0) return own_[static_cast<size_t>(memory)];
    const auto before = std::lower_bound(starts_.begin(), starts_.end(), slot) - starts_.begin();
    return slot + kProgramSkew * static_cast<int32_t>(before);
  }
  int32_t columns() const { return columns_; }

 private:
  std::vector<int32_t> starts_, own_;
  int32_t columns_;
};

// Bytes of the parts of a code, one after another.
struct CodePlaces {
  int64_t packs, steps, operands, sums, scatters, grids, bytes;
};
int64_t aligned(int64_t bytes) { return ceil_div<int64_t>(bytes, 256) * 256; }
CodePlaces code_places(const ProgramTable& table) {
  CodePlaces at{};
  const auto behind = [](int64_t place, const auto& records) {
    return place + aligned(static_cast<int64_t>(records.size() * sizeof(records[0])));
  };
  at.steps = behind(at.packs, table.packs);
  at.operands = behind(at.steps, table.steps);
  at.sums = behind(at.operands, table.operands);
  at.scatters = behind(at.sums, table.sums);
  at.grids = behind(at.scatters, table.scatters);
  at.bytes = at.grids + aligned(static_cast<int64_t>(table.grids.size() * sizeof(HashEncoding)));
  return at;
}

// How a call is cut: rows of a tile and of a task, blocks, at most so many tasks, and where what is in the workspace.
struct Cut {
  int height;
  bool spilled;
  int shared;
  int64_t task_rows, tasks, blocks;
  int64_t partials, slots, bytes;
};

Cut cut(const Program& program, int64_t n, int64_t k) {
  const ProgramTable& table = program.table;
  const Device& device = current_device();
  const size_t most = std::max({table.inputs.size(), static_cast<size_t>(table.parameters), table.outputs.size(),
                                static_cast<size_t>(table.sum_tensors)});
  if (most > kProgramMost) {
    throw std::invalid_argument("grouped_program: a program must have at most " + std::to_string(kProgramMost) +
                                " inputs, parameters, outputs or sums on CUDA, got " + std::to_string(most) +
                                "; use backend='reference'");
  }
  if (table.lookups.size() > kProgramLookups) {
    throw std::invalid_argument("grouped_program: a program must have at most " + std::to_string(kProgramLookups) +
                                " look-ups of hash grids on CUDA, got " + std::to_string(table.lookups.size()) +
                                "; use backend='reference'");
  }
  Cut found{};
  const int64_t columns = Slots(table).columns();
  const auto shared = [&](int rows) { return kStripBytes + 4 * rows * columns; };
  found.height = 2 * shared(64) <= device.shared_bytes ? 64 : 32;
  found.spilled = shared(found.height) > device.shared_bytes;
  if (found.spilled) found.height = 64;
  found.shared = static_cast<int>(found.spilled ? kStripBytes : shared(found.height));
  found.task_rows = kTaskRows;
  if (table.partial > 0) {
    found.task_rows = std::max(found.task_rows, n / (kTasksPerMultiprocessor * device.multiprocessors));
    found.task_rows = std::max(found.task_rows, ceil_div<int64_t>(n * table.partial, kPartialBytes / 4));
  }
  found.task_rows = ceil_div<int64_t>(found.task_rows, kTaskRows) * kTaskRows;
  found.tasks = n / found.task_rows + k;
  found.blocks = found.spilled ? std::min<int64_t>(found.tasks, kResident * device.multiprocessors) : found.tasks;
  found.partials = aligned(4 * (k + 1));
  found.slots = found.partials + aligned(4 * found.tasks * table.partial);
  found.bytes = found.slots + (found.spilled ? aligned(4 * found.blocks * found.height * columns) : 0);
  return found;
}

template <typename Products, int kHeight, bool kSpilled>
void launch(const CudaProgram& call, const Cut& found, int64_t partial, void* stream) {
  const auto kernel = program_kernel<Products, kHeight, kSpilled>;
  // Always the same, since what one host thread sets must do for the launch of another.
  VN_CUDA_CHECK(
      cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, current_device().shared_bytes));
  VN_LAUNCH(kernel, static_cast<unsigned>(found.blocks), kThreads, found.shared, stream, call, partial);
}

template <template <int> typename Products>
void launch_cut(const CudaProgram& call, const Cut& found, int64_t partial, void* stream) {
  if (found.spilled) return launch<Products<4>, 64, true>(call, found, partial, stream);
  if (found.height == 64) return launch<Products<4>, 64, false>(call, found, partial, stream);
  launch<Products<2>, 32, false>(call, found, partial, stream);
}
template <int kDown>
using Bfloat16Products = TensorProducts<HalfFragments<true>, kDown>;
template <int kDown>
using Float16Products = TensorProducts<HalfFragments<false>, kDown>;
template <int kDown>
using Tf32Products = TensorProducts<Tf32Fragments, kDown>;

// Blocks that fill the device, if there is as much to do.
unsigned blocks_for(int64_t entries) {
  const int64_t most = kBlocksPerMultiprocessor * current_device().multiprocessors;
  return static_cast<unsigned>(std::max<int64_t>(1, std::min(most, ceil_div<int64_t>(entries, kThreads))));
}

}  // namespace

int64_t program_code_bytes_cuda(const Program& program) {
  return std::max<int64_t>(1, code_places(program.table).bytes);
}

void program_code_cuda(const Program& program, unsigned char* code) {
  const ProgramTable& table = program.table;
  const CodePlaces at = code_places(table);
  const Slots slots(table);
  std::vector<ProgramStep> steps = table.steps;
  std::vector<ProgramOperand> operands = table.operands;
  // Of each memory of the program what kNoMemory says; outputs are written by their steps alone.
  std::vector<int32_t> memories(table.memories.size(), kNoMemory);
  for (size_t i = 0; i < table.lookups.size(); ++i) {
    memories[static_cast<size_t>(table.lookups[i].memory)] = static_cast<int32_t>(i);
  }
  for (size_t i = 0; i < table.scatters.size(); ++i) {
    memories[static_cast<size_t>(table.scatters[i].memory)] = kNoMemory - 1 - static_cast<int32_t>(i);
  }
  for (ProgramStep& step : steps) {
    const bool made = Slots::makes_value(step);
    if (made) {
      step.slot = slots.at(step.slot, step.memory);
      step.stride += kProgramSkew;
    }
    step.memory = made && step.memory >= 0 ? memories[static_cast<size_t>(step.memory)] : kNoMemory;
  }
  for (ProgramOperand& operand : operands) {
    if (operand.parameter) continue;
    operand.slot = slots.at(operand.slot, operand.memory);
    operand.stride += kProgramSkew;
  }
  std::vector<HashEncoding> grids;
  for (const HashGrid& grid : table.grids) grids.push_back(hash_encoding(HashInputs{}, grid));
  const auto write = [code](int64_t place, const auto& records) {
    if (!records.empty()) std::memcpy(code + place, records.data(), records.size() * sizeof(records[0]));
  };
  write(at.packs, table.packs);
  write(at.steps, steps);
  write(at.operands, operands);
  write(at.sums, table.sums);
  write(at.scatters, table.scatters);
  write(at.grids, grids);
}

int64_t grouped_program_workspace_cuda(const Program& program, int64_t n, int64_t, int64_t k) {
  return cut(program, n, k).bytes;
}

void grouped_program_cuda(const Program& program, const unsigned char* code, const ProgramInputs& in,
                          const ProgramResults& results, ProgramPrecision precision, unsigned char* workspace,
                          void* stream) {
  const ProgramTable& table = program.table;
  const Cut found = cut(program, in.n, in.k);
  const CodePlaces at = code_places(table);
  CudaProgram call{};
  call.code.packs = reinterpret_cast<const ProgramPack*>(code + at.packs);
  call.code.steps = reinterpret_cast<const ProgramStep*>(code + at.steps);
  call.code.operands = reinterpret_cast<const ProgramOperand*>(code + at.operands);
  call.code.sums = reinterpret_cast<const ProgramSum*>(code + at.sums);
  call.code.step_count = static_cast<int32_t>(table.steps.size());
  call.code.sum_count = static_cast<int32_t>(table.sums.size());
  call.code.columns = Slots(table).columns();
  call.scatters = reinterpret_cast<const ProgramScatter*>(code + at.scatters);
  call.grids = reinterpret_cast<const HashEncoding*>(code + at.grids);
  call.rows = {in.offsets, in.order, in.ray_index, reinterpret_cast<int32_t*>(workspace), in.n, in.r, in.k};
  call.partials = reinterpret_cast<float*>(workspace + found.partials);
  call.spilled = reinterpret_cast<float*>(workspace + found.slots);
  call.task_rows = found.task_rows;
  for (size_t i = 0; i < table.inputs.size(); ++i) {
    call.inputs[i] = in.inputs[i];
    call.input_types[i] = static_cast<uint8_t>(in.input_types[i]);
    call.turned[i] = in.turned[i] != 0;
    call.rays[i] = table.inputs[i].ray;
  }
  for (int32_t i = 0; i < table.parameters; ++i) {
    call.parameters[i] = in.parameters[i];
    call.parameter_types[i] = static_cast<uint8_t>(in.parameter_types[i]);
    call.strides[i] = in.strides[i];
  }
  for (size_t i = 0; i < table.outputs.size(); ++i) {
    call.outputs[i] = results.outputs[i];
    call.output_types[i] = static_cast<uint8_t>(results.output_types[i]);
    call.output_widths[i] = table.outputs[i].width;
  }
  call.output_count = static_cast<int32_t>(table.outputs.size());
  std::copy_n(results.sums, table.sum_tensors, call.sums);
  for (size_t i = 0; i < table.lookups.size(); ++i) {
    call.kept[i] = in.kept == nullptr ? nullptr : in.kept[i];
    call.kept_strides[i] = table.memories[static_cast<size_t>(table.lookups[i].memory)];
  }
  call.lookup_count = static_cast<int32_t>(table.lookups.size());
  call.ready = in.ready;

  for (const ProgramScatter& scatter : table.scatters) {
    const HashGrid& grid = table.grids[static_cast<size_t>(scatter.grid)];
    const int64_t stride = in.strides[static_cast<size_t>(scatter.parameter)];
    const int64_t entries = grid.levels.back().offset + grid.levels.back().entries;
    const int64_t size = stride > 0 ? in.k * stride : entries * grid.features;
    VN_CUDA_CHECK(cudaMemsetAsync(results.sums[scatter.sum], 0, 4 * static_cast<size_t>(size),
                                  static_cast<cudaStream_t>(stream)));
  }
  VN_LAUNCH(program_prepare_kernel, blocks_for(in.n), kThreads, 0, stream, call, found.tasks);
  if (in.n > 0 && in.k > 0) {
    if (current_device().capability < 80 && precision != ProgramPrecision::float16) {
      precision = ProgramPrecision::float32;  // there are no such products
    }
    switch (precision) {
      case ProgramPrecision::float32:
        launch_cut<FloatProducts>(call, found, table.partial, stream);
        break;
      case ProgramPrecision::tf32:
        launch_cut<Tf32Products>(call, found, table.partial, stream);
        break;
      case ProgramPrecision::bfloat16:
        launch_cut<Bfloat16Products>(call, found, table.partial, stream);
        break;
      case ProgramPrecision::float16:
        launch_cut<Float16Products>(call, found, table.partial, stream);
        break;
    }
  }
  if (!table.sums.empty() && in.k > 0) {
    const int64_t blocks = kBlocksPerMultiprocessor * current_device().multiprocessors;
    const int64_t useful = ceil_div<int64_t>(std::max(table.partial, 1), kThreads);
    const dim3 grid(static_cast<unsigned>(in.k),
                    static_cast<unsigned>(std::min(useful, ceil_div<int64_t>(blocks, in.k))));
    VN_LAUNCH(program_reduce_kernel, grid, kThreads, 0, stream, call, table.partial);
  }
}

}  // namespace voronerf
