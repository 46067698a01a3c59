// Programs on CUDA: an interpreter. A block takes a task, rows of one cell, and all of its threads do one step after
// another for a tile of rows, whose values lie in shared memory, each [rows][stride] at its slot.
//
// Layers: weights come from global memory through a strip of shared memory, 16 inputs of 64 outputs at a time; a thread
// has kPer rows by four outputs in registers, so that one 16-byte load of weights serves 4 kPer products. Sums over
// rows: a thread has the same 4 x 4 entries in every tile and adds to them in the task's partial in global memory; a
// second kernel adds up the partials of a cell in their order, so results are the same every time. All is float32.
#include <algorithm>
#include <stdexcept>
#include <string>

#include "network/cpu/program_code.h"
#include "network/cuda/grouped_mlp_cuda_tile.h"
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

constexpr int kThreads = 256, kAcross = 16, kRowsAtOnce = kThreads / kAcross;
constexpr int kDepth = 16, kWide = 64, kStripStride = kWide + 4;  // of the strip of weights; padded against conflicts
constexpr int kMost = 64;                                         // tensors of a kind: kernel arguments hold 4 KiB
constexpr int64_t kTaskRows = 128, kTasksPerMultiprocessor = 4, kPartialBytes = int64_t{1} << 28;

// Pointers of a call, on the device.
struct Tensors {
  const int32_t* code;
  const float* constants;
  const float *inputs[kMost], *parameters[kMost];
  float *outputs[kMost], *sums[kMost];
  int64_t strides[kMost];
  bool turned[kMost];
};

// Columns of a value or of a cell's vector.
struct Rows {
  const float* data;
  int stride;
  bool spread;
  __device__ float at(int row, int column) const { return data[row * stride + (spread ? 0 : column)]; }
};

__device__ const ProgramPack* packs_of(const int32_t* code) {
  return reinterpret_cast<const ProgramPack*>(code + sizeof(ProgramHeader) / 4);
}

// to[row][column] = body(row, column) for all entries.
template <typename Body>
__device__ void each(float* to, int stride, int rows, int width, const Body& body) {
  for (int i = static_cast<int>(threadIdx.x); i < rows * width; i += kThreads) {
    const int row = i / width, column = i - row * width;
    to[row * stride + column] = body(row, column);
  }
}

template <typename Function>
__device__ void apply(const ProgramStep& step, float* to, int rows, const Rows& x, const Rows* times, float a,
                      float b) {
  each(to, step.stride, rows, step.width, [&](int row, int column) {
    const float v = x.at(row, column), by = times == nullptr ? 1.0f : times->at(row, column);
    switch (step.order) {
      case 0:
        return by * Function::template at<0>(v, a, b);
      case 1:
        return by * Function::template at<1>(v, a, b);
      case 2:
        return by * Function::template at<2>(v, a, b);
      default:
        return by * Function::template at<3>(v, a, b);
    }
  });
}

template <int kPer>
struct Tile {
  const Tensors& tensors;
  const MlpCudaData& data;
  float *slots, *strip, *partial;
  int64_t cell, begin;
  int rows;
  bool fill;  // the first tile of a task

  static constexpr int kRows = kPer * kRowsAtOnce;

  __device__ float* slot(int32_t columns) const { return slots + columns * kRows; }
  __device__ const float* parameter(const ProgramPack& pack) const {
    return tensors.parameters[pack.parameter] + cell * tensors.strides[pack.parameter] + pack.start;
  }
  __device__ Rows operand(const ProgramOperand& o) const {
    if (o.parameter) return {parameter(packs_of(tensors.code)[o.slot]), 0, o.spread != 0};
    return {slot(o.slot) + o.start, o.stride, o.spread != 0};
  }

  // The order is a caller's.
  __device__ int64_t source_row(int64_t row) const { return mlp_within(mlp_source_row(data, row), data.n); }

  __device__ void run() const {
    const auto& header = *reinterpret_cast<const ProgramHeader*>(tensors.code);
    const auto* code = reinterpret_cast<const int32_t*>(packs_of(tensors.code) + header.packs);
    for (int i = 0; i < header.steps; ++i) {
      const auto& step = *reinterpret_cast<const ProgramStep*>(code);
      const auto* operands = reinterpret_cast<const ProgramOperand*>(code + sizeof(ProgramStep) / 4);
      run_step(step, operands);
      __syncthreads();
      code = reinterpret_cast<const int32_t*>(operands + step.count);
    }
  }

  __device__ void run_step(const ProgramStep& step, const ProgramOperand* operands) const {
    float* const to = slot(step.slot);
    const Rows x = step.count > 0 ? operand(operands[0]) : Rows{}, y = step.count > 1 ? operand(operands[1]) : Rows{};
    switch (step.op) {
      case kProgramInput: {
        const float* from = tensors.inputs[step.number];
        const bool turned = tensors.turned[step.number];
        return each(to, step.stride, rows, step.width, [&](int row, int column) {
          const int64_t source = source_row(begin + row);
          return from[turned ? column * data.n + source : source * step.width + column];
        });
      }
      case kProgramOutput: {
        float* out = tensors.outputs[step.number];
        for (int i = static_cast<int>(threadIdx.x); i < rows * step.width; i += kThreads) {
          const int row = i / step.width, column = i - row * step.width;
          out[source_row(begin + row) * step.width + column] = x.at(row, column);
        }
        return;
      }
      case kProgramLinear:
        return linear(step, operands, x);
      case kProgramFunction: {
        const float a = tensors.constants[step.constants], b = tensors.constants[step.constants + 1];
        switch (step.name) {
#define VN_CASE(NAME, ...)       \
  case device::kFunction_##NAME: \
    return apply<device::NAME##_function>(step, to, rows, x, step.count > 1 ? &y : nullptr, a, b);
          VN_FUNCTIONS(VN_CASE)
#undef VN_CASE
        }
        return;
      }
      case kProgramBinary:
        return each(to, step.stride, rows, step.width, [&](int row, int column) {
          const float a = x.at(row, column), b = y.at(row, column);
          switch (step.name) {
            case kProgramAdd:
              return a + b;
            case kProgramSub:
              return a - b;
            case kProgramMul:
              return a * b;
            case kProgramDiv:
              return a / b;
            default:
              return b == 0.0f ? 0.0f : a;
          }
        });
      case kProgramTotal:
        return each(to, step.stride, rows, step.width, [&](int row, int column) {
          float sum = 0.0f;
          for (int i = 0; i < step.number; ++i) sum += x.at(row, column * step.number + i);
          return sum;
        });
      case kProgramMove:
        return each(to, step.stride, rows, step.width, [&](int row, int column) {
          float sum = 0.0f;
          for (int i = 0; i < step.count; ++i) {
            const int within = column - operands[i].place;
            if (within >= 0 && within < operands[i].width) sum += operand(operands[i]).at(row, within);
          }
          return sum;
        });
      case kProgramColumns:
        for (int column = static_cast<int>(threadIdx.x); column < step.width; column += kThreads) {
          float sum = fill ? 0.0f : partial[step.number + column];
          for (int row = 0; row < rows; ++row) sum += x.at(row, column);
          partial[step.number + column] = sum;
        }
        return;
      default:
        return step.depth ? outer(step, x, y, operands[0].width, operands[1].width)
                          : outer(step, y, x, operands[1].width, operands[0].width);
    }
  }

  // Rows that are none get what lies in the slots, and are not stored.
  __device__ void linear(const ProgramStep& step, const ProgramOperand* operands, const Rows& x) const {
    const ProgramPack pack = packs_of(tensors.code)[step.number];
    const float* weights = parameter(pack);
    const bool turned = pack.kind % 2 == 1, added = step.count > 1 + (step.finish == 2);
    const Rows add = added ? operand(operands[1]) : Rows{};
    const Rows slope = step.finish == 2 ? operand(operands[step.count - 1]) : Rows{};
    const int thread = static_cast<int>(threadIdx.x), across = thread % kAcross, down = thread / kAcross;
    float* const to = slot(step.slot);
    for (int first = 0; first < step.width; first += kWide) {
      float sums[kPer][4];
      for (int r = 0; r < kPer; ++r) {
        for (int c = 0; c < 4; ++c) {
          const int row = down + r * kRowsAtOnce, column = first + 4 * across + c;
          sums[r][c] = added && row < rows && column < step.width ? add.at(row, column) : 0.0f;
        }
      }
      for (int start = 0; start < step.depth; start += kDepth) {
        const int deep = step.depth - start < kDepth ? step.depth - start : kDepth;
        __syncthreads();  // the strip has been read
        for (int i = thread; i < kDepth * kWide; i += kThreads) {
          const int k = turned ? i / kWide : i % kDepth, o = turned ? i % kWide : i / kDepth;
          const int input = start + k, output = first + o;
          const bool inside = k < deep && output < step.width;
          strip[k * kStripStride + o] =
              inside ? weights[turned ? input * pack.i + output : output * pack.i + input] : 0.0f;
        }
        __syncthreads();
        for (int k = 0; k < deep; ++k) {
          const float4 w = *reinterpret_cast<const float4*>(strip + k * kStripStride + 4 * across);
#pragma unroll
          for (int r = 0; r < kPer; ++r) {
            const float a = x.data[(down + r * kRowsAtOnce) * x.stride + start + k];
            sums[r][0] = fmaf(a, w.x, sums[r][0]);
            sums[r][1] = fmaf(a, w.y, sums[r][1]);
            sums[r][2] = fmaf(a, w.z, sums[r][2]);
            sums[r][3] = fmaf(a, w.w, sums[r][3]);
          }
        }
      }
      for (int r = 0; r < kPer; ++r) {
        for (int c = 0; c < 4; ++c) {
          const int row = down + r * kRowsAtOnce, column = first + 4 * across + c;
          if (row >= rows || column >= step.width) continue;
          float value = sums[r][c];  // comparisons keep NaN
          if (step.finish == 1) value = value < 0.0f ? 0.0f : value;
          if (step.finish == 2) value = slope.at(row, column) <= 0.0f ? 0.0f : value;
          to[row * step.stride + column] = value;
        }
      }
    }
  }

  // partial[i][j] += sum over rows of a[row][i] b[row][j].
  __device__ void outer(const ProgramStep& step, const Rows& a, const Rows& b, int of_a, int of_b) const {
    const int wide = (of_b + 3) / 4, blocks = (of_a + 3) / 4 * wide;
    for (int block = static_cast<int>(threadIdx.x); block < blocks; block += kThreads) {
      const int i0 = 4 * (block / wide), j0 = 4 * (block % wide);
      float sums[4][4] = {};
      for (int row = 0; row < rows; ++row) {
        float left[4], right[4];
        for (int i = 0; i < 4; ++i) left[i] = a.at(row, i0 + i < of_a ? i0 + i : i0);
        for (int j = 0; j < 4; ++j) right[j] = b.at(row, j0 + j < of_b ? j0 + j : j0);
        for (int i = 0; i < 4; ++i) {
          for (int j = 0; j < 4; ++j) sums[i][j] = fmaf(left[i], right[j], sums[i][j]);
        }
      }
      for (int i = 0; i < 4; ++i) {
        for (int j = 0; j < 4; ++j) {
          if (i0 + i >= of_a || j0 + j >= of_b) continue;
          float& entry = partial[step.number + (i0 + i) * step.stride + j0 + j];
          entry = (fill ? 0.0f : entry) + sums[i][j];
        }
      }
    }
  }
};

template <int kPer>
__global__ void __launch_bounds__(kThreads, 2)
    program_kernel(const Tensors tensors, const MlpCudaData data, int64_t task_rows, int64_t partial) {
  MlpTask task;
  if (!mlp_find_task(data, task_rows, blockIdx.x, task)) return;  // the whole block
  VN_DYN_SHARED(float4, shared);
  float* strip = reinterpret_cast<float*>(shared);
  float* to = partial > 0 ? data.partials + blockIdx.x * partial : nullptr;
  for (int64_t row = task.begin; row < task.end; row += Tile<kPer>::kRows) {
    const int64_t left = task.end - row;
    const int rows = static_cast<int>(left < Tile<kPer>::kRows ? left : Tile<kPer>::kRows);
    Tile<kPer>{tensors, data, strip + kDepth * kStripStride, strip, to, task.cell, row, rows, row == task.begin}.run();
  }
}

// Grid (k, blocks of a cell).
__global__ void __launch_bounds__(kThreads)
    program_reduce_kernel(const Tensors tensors, const MlpCudaData data, int64_t partial) {
  const auto& header = *reinterpret_cast<const ProgramHeader*>(tensors.code);
  const auto* code = reinterpret_cast<const int32_t*>(packs_of(tensors.code) + header.packs);
  for (int i = 0; i < header.steps; ++i) {
    code += (sizeof(ProgramStep) + reinterpret_cast<const ProgramStep*>(code)->count * sizeof(ProgramOperand)) / 4;
  }
  const auto* records = reinterpret_cast<const ProgramSum*>(code);
  const int64_t cell = blockIdx.x, first = data.first_task[cell], last = data.first_task[cell + 1];
  for (int s = 0, next; s < header.sums; s = next) {
    for (next = s + 1; next < header.sums && records[next].sum == records[s].sum;) ++next;
    const int size = records[s].size;
    for (int i = static_cast<int>(blockIdx.y * kThreads + threadIdx.x); i < size; i += gridDim.y * kThreads) {
      float total = 0.0f;
      for (int r = s; r < next; ++r) {
        const ProgramSum& sum = records[r];
        if (sum.kind < 0) continue;
        const int o = sum.kind == 2 ? 0 : i / sum.i, column = i - o * sum.i * (sum.kind != 2) - sum.start;
        if (column < 0 || column >= sum.width) continue;
        const int at = sum.partial + (sum.kind == 0 ? column * sum.stride + o : o * sum.stride + column);
        for (int64_t task = first; task < last; ++task) total += data.partials[task * partial + at];
      }
      tensors.sums[records[s].sum][cell * size + i] = total;
    }
  }
}

// How a call is cut: rows of a tile and of a task, at most so many tasks, and bytes.
struct Cut {
  int rows;
  int64_t task_rows, tasks, partials, bytes;
  int shared;
};

Cut cut(const ProgramSizes& sizes, int64_t n, int64_t k) {
  const MlpCudaDevice device = mlp_cuda_device();
  const auto shared = [&](int rows) { return 4 * (rows * sizes.columns + kDepth * kStripStride); };
  const int64_t most = std::max({sizes.inputs, sizes.parameters, sizes.outputs, sizes.sums});
  if (most > kMost) {
    throw std::invalid_argument("grouped_program: a program must have at most " + std::to_string(kMost) +
                                " inputs, parameters, outputs or sums on CUDA, got " + std::to_string(most) +
                                "; use backend='reference'");
  }
  const int rows = shared(2 * kRowsAtOnce) <= device.shared_bytes ? 2 * kRowsAtOnce : kRowsAtOnce;
  if (shared(rows) > device.shared_bytes) {
    throw std::invalid_argument("grouped_program: a program's values of " + std::to_string(rows) +
                                " rows must fit into the " + std::to_string(device.shared_bytes) +
                                " bytes of a block's shared memory on CUDA, got " + std::to_string(shared(rows)) +
                                "; use backend='reference'");
  }
  int64_t task_rows = kTaskRows;
  if (sizes.partial > 0) {
    task_rows = std::max(task_rows, n / (kTasksPerMultiprocessor * device.multiprocessors));
    task_rows = std::max(task_rows, ceil_div<int64_t>(n * sizes.partial, kPartialBytes / 4));
  }
  task_rows = ceil_div<int64_t>(task_rows, kTaskRows) * kTaskRows;
  const int64_t tasks = n / task_rows + k, partials = ceil_div<int64_t>(4 * (k + 1), 256) * 256;
  return {rows, task_rows, tasks, partials, partials + 4 * tasks * sizes.partial, static_cast<int>(shared(rows))};
}

template <int kPer>
void launch(const Tensors& tensors, const MlpCudaData& data, const Cut& found, int64_t partial, void* stream) {
  mlp_allow_shared(program_kernel<kPer>);
  VN_LAUNCH((program_kernel<kPer>), static_cast<unsigned>(found.tasks), kThreads, found.shared, stream, tensors, data,
            found.task_rows, partial);
}

}  // namespace

int64_t grouped_program_workspace_cuda(const ProgramSizes& sizes, int64_t n, int64_t k) {
  return cut(sizes, n, k).bytes;
}

void grouped_program_cuda(const ProgramInputs& in, const ProgramSizes& sizes, float* const* outputs, float* const* sums,
                          unsigned char* workspace, void* stream) {
  const Cut found = cut(sizes, in.n, in.k);
  Tensors tensors{};
  tensors.code = in.code;
  tensors.constants = in.constants;
  for (int64_t i = 0; i < sizes.inputs; ++i) {
    tensors.inputs[i] = in.inputs[i];
    tensors.turned[i] = in.turned[i] != 0;
  }
  for (int64_t i = 0; i < sizes.parameters; ++i) {
    tensors.parameters[i] = in.parameters[i];
    tensors.strides[i] = in.strides[i];
  }
  std::copy_n(outputs, sizes.outputs, tensors.outputs);
  std::copy_n(sums, sizes.sums, tensors.sums);
  MlpCudaData data{};
  data.order = in.order;
  data.offsets = in.offsets;
  data.n = in.n;
  data.k = in.k;
  data.first_task = reinterpret_cast<int32_t*>(workspace);
  data.partials = reinterpret_cast<float*>(workspace + found.partials);
  for (int64_t i = 0; i < sizes.outputs; ++i) {
    mlp_cuda_zero_strays(data, static_cast<int>(in.widths[i]), outputs[i], stream);
  }
  mlp_cuda_number_tasks(data, found.task_rows, found.tasks, stream);
  if (in.n > 0) {
    found.rows == kRowsAtOnce ? launch<1>(tensors, data, found, sizes.partial, stream)
                              : launch<2>(tensors, data, found, sizes.partial, stream);
  }
  if (sizes.sums > 0) {
    const dim3 grid(static_cast<unsigned>(in.k), mlp_cuda_layer_blocks(in.k, 1, std::max<int64_t>(sizes.partial, 1)));
    VN_LAUNCH(program_reduce_kernel, grid, kThreads, 0, stream, tensors, data, sizes.partial);
  }
}

}  // namespace voronerf
