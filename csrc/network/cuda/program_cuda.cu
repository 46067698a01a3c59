// Programs on CUDA: an interpreter. A block takes tasks, rows of one cell, a tile of them after the other. Of a tile
// each of its warps has 16 or 32 rows of its own, and does one step after another for them without waiting for the
// others; but for sums over rows, which all warps make together for all rows. Where the values of few rows fit, four
// warps are a team that has 16 rows and shares the columns.
//
// Values lie in shared memory, for each team [rows][stride] at their slot: as float32, and with products of 16 bits as
// words of two such numbers wherever only products read them. What one product makes and the next one reads stays in
// registers. Where less than two teams fit, values lie in the workspace instead, a part for each block that is
// resident.
//
// Layers: weights are packed once for a call, in the order and the type that products take them in
// (program_cuda_product.h). Sums over rows: a thread has the same entries in every tile and adds to them in the task's
// partial in global memory; a second kernel adds up the partials of a cell in their order, so results are the same
// every time. Gradients of tables alone are added up by atomic operations, in any order.
//
// Budget: registers for two blocks of 8 warps with 16 rows each, or three of 4 warps with 32 rows. What is not a
// product is not inlined.
#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>

#include "network/cuda/program_cuda_encoding.h"
#include "network/cuda/program_cuda_product.h"
#include "network/functions.h"
#include "network/program.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int64_t kPartialBytes = int64_t{1} << 28;
constexpr int64_t kBlocksPerMultiprocessor = 8;  // of kernels other than the interpreter
constexpr int kPackPart = 1024;                  // words of what is packed that a block takes at a time
constexpr int64_t kReservedBytes = 1024;         // of shared memory, for each block
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

template <typename Tile>
__device__ __noinline__ void function_step(Tile tile, const ProgramStep& step, const ProgramOperand* operands) {
  const Rows x = tile.operand(operands[0]), times = tile.operand(operands[step.taken - 1]);
  const float a = step.a, b = step.b;
  const int order = step.order;
  const bool alone = step.taken == 1;
  const auto to = tile.target(step);
  switch (step.function) {
#define VN_CASE(NAME, ...)                                                                           \
  case ProgramFunction::NAME:                                                                        \
    return for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {                  \
      const float by = alone ? 1.0f : times.at(row, column);                                         \
      to.put(row, column, by * derivative<device::NAME##_function>(order, x.at(row, column), a, b)); \
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

template <typename Tile>
__device__ __forceinline__ void move_step(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands) {
  const auto to = tile.target(step);
  if (step.order == 1) {  // every column has one part
    for (int i = 0; i < step.taken; ++i) {
      const Rows x = tile.operand(operands[i]);
      const int place = operands[i].place;
      for_each_entry<Tile>(tile.rows(), operands[i].width,
                           [&](int row, int column) { to.put(row, place + column, x.at(row, column)); });
    }
    return;
  }
  for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {
    float sum = 0.0f;
    for (int i = 0; i < step.taken; ++i) {
      const int within = column - operands[i].place;
      if (within >= 0 && within < operands[i].width) sum += tile.operand(operands[i]).at(row, within);
    }
    to.put(row, column, sum);
  });
}

// What neither multiplies nor is in memory of the caller's.
template <typename Tile>
__device__ __noinline__ void plain_step(Tile tile, const ProgramStep& step) {
  const ProgramOperand* operands = tile.call.code.operands + step.first;
  const bool there = step.op == ProgramOp::encode && tile.call.ready && step.memory >= 0;
  if (step.op == ProgramOp::encode && !(there && tile.call.kept[step.memory] != nullptr)) {
    return encode_step(tile, step, operands);
  }
  if (step.op == ProgramOp::function) return function_step(tile, step, operands);
  const auto to = tile.target(step);
  switch (step.op) {
    case ProgramOp::binary: {
      const Rows x = tile.operand(operands[0]), y = tile.operand(operands[1]);
      return for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {
        to.put(row, column, binary(step.binary, x.at(row, column), y.at(row, column)));
      });
    }
    case ProgramOp::total: {
      const Rows x = tile.operand(operands[0]);
      return for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {
        float sum = 0.0f;
        for (int i = 0; i < step.number; ++i) sum += x.at(row, column * step.number + i);
        to.put(row, column, sum);
      });
    }
    case ProgramOp::move:
      return move_step(tile, step, operands);
    default: {  // what is looked up already
      const int64_t stride = tile.call.kept_strides[step.memory];
      const float* from = tile.call.kept[step.memory] + tile.begin() * stride;
      return for_each_entry<Tile>(tile.rows(), step.width,
                                  [&](int row, int column) { to.put(row, column, from[row * stride + column]); });
    }
  }
}

// What becomes of a value beside its slot: what was looked up is kept, and the gradient of that is added to that of the
// table.
template <typename Tile>
__device__ __noinline__ void keep(Tile tile, const ProgramStep& step) {
  const CudaProgram& call = tile.call;
  if (step.memory < kNoMemory) return scatter_rows(tile, step, call.scatters[kNoMemory - 1 - step.memory]);
  if (call.kept[step.memory] == nullptr || call.ready) return;
  const int64_t stride = call.kept_strides[step.memory];
  float* const to = call.kept[step.memory] + tile.begin() * stride;
  const float* from = tile.slot(step.slot);
  for_each_entry<Tile>(tile.rows(), static_cast<int>(stride), [&](int row, int column) {
    to[row * stride + column] = column < step.width ? from[row * step.stride + column] : 0.0f;
  });
}

// Kernels --------------------------------------------------------------------------------------------------------

// The last of the cells whose first task is not above one, by all lanes of a warp.
__device__ __forceinline__ int cell_of_task(const CudaRows& rows, int task) {
  const int lane = static_cast<int>(threadIdx.x % 32);
  MapSpan cells{0, rows.k};
  while (cells.last - cells.first > 1) {
    const int64_t at = probed(cells, lane);
    const unsigned votes = __ballot_sync(kAllLanes, at < cells.last && rows.first_task[at] <= task);
    cells = narrowed(cells, __popc(votes));
  }
  return static_cast<int>(cells.first);
}

// Steps from `i` on that a team does by itself; returns the number of the next one that it does not.
template <typename Steps, typename Tile>
__device__ __forceinline__ int own_steps(const CudaProgram& call, const Tile& tile, int i) {
  for (; i < call.code.step_count; ++i) {
    CudaStep step = load_step(call.steps + i);
    if (step.sums()) break;
    if (Tile::kHalves && step.pairs >= 0 && (step.op == CudaOp::plain || step.op == CudaOp::input)) {
      clear_rest(tile, step);
    }
    if (step.op == CudaOp::plain) {
      plain_step(tile, call.code.steps[i]);
    } else if (step.op == CudaOp::input) {
      input_step(tile, step);
    } else if (step.op == CudaOp::output) {
      output_step(tile, step);
    } else {
      typename Steps::Held held;
      for (;;) {
        if (step.op == CudaOp::chain) {
          Steps::chained(tile, step, held);
        } else {
          Steps::linear(tile, step, i, held);
        }
        if (!step.holds) break;
        Tile::sync();
        step = load_step(call.steps + ++i);
      }
    }
    Tile::sync();
    if (step.keeps) {
      keep(tile, call.code.steps[i]);
      Tile::sync();
    }
  }
  return i;
}
// The same for a warp that has no rows.
__device__ __forceinline__ int next_sum(const CudaProgram& call, int i) {
  while (i < call.code.step_count && !load_step(call.steps + i).sums()) ++i;
  return i;
}
template <typename Steps, typename Tile>
__device__ __forceinline__ int sums(const CudaProgram& call, const Tile& tile, int i) {
  for (; i < call.code.step_count; ++i) {
    const CudaStep step = load_step(call.steps + i);
    if (step.op == CudaOp::outer) {
      Steps::outer(tile, step);
    } else if (step.op == CudaOp::columns) {
      Steps::columns(tile, step);
    } else {
      break;
    }
  }
  return i;
}

// Rows of a block's tile.
template <typename Tile>
__device__ __forceinline__ int tile_height() {
  return static_cast<int>(threads_again() / Tile::kWorkers) * Tile::kRows;
}
// The rows of a tile, from `left` of the task on.
template <typename Tile>
__device__ __forceinline__ void cut_rows(TileState& state, int left) {
  const int height = tile_height<Tile>(), all = left < height ? left : height;
  const int own = all - static_cast<int>(threadIdx.x / Tile::kWorkers) * Tile::kRows;
  state.left = left, state.all = all;
  state.rows = own < 0 ? 0 : own < Tile::kRows ? own : Tile::kRows;
}
template <typename Tile>
__device__ __forceinline__ void begin_task(const CudaProgram& call, int task, int64_t partial) {
  const CudaRows& rows = call.rows;
  const int cell = cell_of_task(rows, task);
  const int64_t first = cell_begin(rows, cell), last = first + cell_rows(rows, cell);
  const int64_t begin = first + (task - rows.first_task[cell]) * call.task_rows;
  if (threadIdx.x % 32 == 0) {
    TileState& state = Tile::state();
    state.partial = task * partial;
    state.weights = call.packed + cell * call.packed_stride;
    state.cell = cell;
    state.begin = static_cast<int>(begin) + static_cast<int>(threadIdx.x / Tile::kWorkers) * Tile::kRows;
    state.fill = 1;
    cut_rows<Tile>(state, static_cast<int>(last - begin < call.task_rows ? last - begin : call.task_rows));
  }
  __syncwarp();
}
// Returns whether the task has another tile.
template <typename Tile>
__device__ __forceinline__ bool next_tile() {
  TileState& state = Tile::state();
  const int height = tile_height<Tile>(), left = state.left - height;
  __syncwarp();
  if (threadIdx.x % 32 == 0) {
    state.begin += height;
    state.fill = 0;
    cut_rows<Tile>(state, left);
  }
  __syncwarp();
  return left > 0;
}

template <typename Steps>
__global__ void __launch_bounds__(32 * program_warps(Steps::Tile::kRows), program_blocks(Steps::Tile::kRows))
    program_kernel(const VN_GRID_CONSTANT CudaProgram call, int64_t partial) {
  using Tile = typename Steps::Tile;
  const Tile tile{call};
  const CudaRows& rows = call.rows;
  for (int task = blockIdx.x; task < rows.first_task[rows.k]; task += gridDim.x) {
    begin_task<Tile>(call, task, partial);
    do {
      for (int i = 0;;) {
        i = Tile::kTeam == 1 && tile.rows() == 0 ? next_sum(call, i) : own_steps<Steps>(call, tile, i);
        if (i == call.code.step_count) break;
        __syncthreads();
        i = sums<Steps>(call, tile, i);
        __syncthreads();
      }
    } while (next_tile<Tile>());
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

// Word `word` of a matrix as products take it: in the order of fragments, or [depth][outputs].
__device__ __forceinline__ uint32_t any_packed_word(const PackedMatrix& matrix, ProgramPrecision precision, int outputs,
                                                    int word) {
  switch (precision) {
    case ProgramPrecision::tf32:
      return packed_word<Tf32Numbers>(matrix, word);
    case ProgramPrecision::bfloat16:
      return packed_word<HalfNumbers<true>>(matrix, word);
    case ProgramPrecision::float16:
      return packed_word<HalfNumbers<false>>(matrix, word);
    default: {
      const float value = matrix.at(word / outputs, word % outputs);
      uint32_t bits;
      memcpy(&bits, &value, sizeof bits);
      return bits;
    }
  }
}

// Of each cell's matrices and biases, as products take them. A block takes a part of one at a time.
__device__ void pack_weights(const CudaProgram& call, ProgramPrecision precision) {
  const bool halves = precision == ProgramPrecision::bfloat16 || precision == ProgramPrecision::float16;
  const bool tensors = precision != ProgramPrecision::float32;
  const int deep = halves ? HalfNumbers<true>::kChunk : Tf32Numbers::kChunk, packs = call.code.pack_count;
  for (int64_t unit = blockIdx.x; unit < call.rows.k * packs * call.pack_parts; unit += gridDim.x) {
    const int part = static_cast<int>(unit % call.pack_parts);
    const int64_t rest = unit / call.pack_parts, cell = rest / packs;
    const ProgramPack pack = call.code.packs[rest % packs];
    const bool turned = pack.kind == ProgramPackKind::turned, vector = pack.kind == ProgramPackKind::vector;
    if (!turned && !vector && pack.kind != ProgramPackKind::matrix) continue;
    const float* from =
        static_cast<const float*>(call.parameters[pack.parameter]) + cell * call.strides[pack.parameter] + pack.start;
    PackedMatrix matrix{from, turned ? pack.i : 1, turned ? 1 : pack.i, turned ? pack.o : pack.width,
                        turned ? pack.width : pack.o};
    if (vector) matrix = {from, 0, 1, 1, pack.width};
    const int outputs = padded(matrix.outputs, kProgramOutputs);
    // Of a bias for tensor cores the two columns of a lane come twice, as it has them in two rows.
    const int words = vector ? (tensors ? 2 : 1) * outputs : padded(matrix.depth, deep) * outputs / (halves ? 2 : 1);
    auto* const to = reinterpret_cast<uint32_t*>(call.packed) + cell * call.packed_stride + pack.at;
    const int last = words < (part + 1) * kPackPart ? words : (part + 1) * kPackPart;
    for (int word = part * kPackPart + static_cast<int>(threadIdx.x); word < last; word += kThreads) {
      const int column = vector && tensors ? word / 4 * 2 + word % 2 : word;
      to[word] = any_packed_word(matrix, vector ? ProgramPrecision::float32 : precision, outputs, column);
    }
  }
}

// What rows of no cell have: 0 in outputs, and in what is kept.
__device__ void clear_strays(const CudaProgram& call) {
  const CudaRows& rows = call.rows;
  const int64_t low = cell_begin(rows, 0), last = cell_begin(rows, rows.k), high = last < low ? low : last;
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads, strays = rows.n - (high - low);
  for (int o = 0; o < call.output_count; ++o) {
    const int width = call.output_widths[o];
    for (int64_t i = begin; i < strays * width; i += step) {
      const int64_t stray = i / width, row = source_row(rows, stray < low ? stray : stray + high - low);
      store_number(call.outputs[o], call.output_types[o], row * width + i - stray * width, 0.0f);
    }
  }
  for (int l = 0; l < call.lookup_count; ++l) {
    const int64_t stride = call.kept_strides[l];
    if (call.kept[l] == nullptr || call.ready) continue;
    for (int64_t i = begin; i < strays * stride; i += step) {
      call.kept[l][i < low * stride ? i : i + (high - low) * stride] = 0.0f;
    }
  }
}

// The first block numbers the tasks.
__global__ void __launch_bounds__(kThreads)
    program_prepare_kernel(const VN_GRID_CONSTANT CudaProgram call, int64_t most, ProgramPrecision precision) {
  if (blockIdx.x == 0) number_tasks(call.rows, call.task_rows, most);
  pack_weights(call, precision);
  clear_strays(call);
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
        const float* from = call.partials + at;
        int64_t task = first;
        for (; task + 8 <= last; task += 8) {  // several loads on their way at a time
          float parts[8];
#pragma unroll
          for (int p = 0; p < 8; ++p) parts[p] = from[(task + p) * partial];
#pragma unroll
          for (int p = 0; p < 8; ++p) total += parts[p];
        }
        for (; task < last; ++task) total += from[task * partial];
      }
      call.sums[code.sums[s].sum][cell * size + i] = total;
    }
  }
}

// Launches -------------------------------------------------------------------------------------------------------

struct Device {
  int multiprocessors, shared_bytes;
  int64_t multiprocessor_bytes;
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
  found.multiprocessor_bytes = found.shared_bytes + kReservedBytes;
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
      if (!makes_value(step)) continue;
      if (step.floats) starts_.push_back(step.slot);
      if (step.pairs >= 0) starts_.push_back(step.pairs);
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
  int64_t packs, steps, operands, sums, scatters, grids, own_steps, bytes;
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
  at.own_steps = at.grids + aligned(static_cast<int64_t>(table.grids.size() * sizeof(HashEncoding)));
  at.bytes = at.own_steps + aligned(static_cast<int64_t>(table.steps.size() * sizeof(CudaStep)));
  return at;
}

// Words that the largest of what is packed takes, at most: up to where the next one begins.
int32_t largest_pack(const ProgramTable& table) {
  int32_t largest = 1;
  for (size_t i = 0; i < table.packs.size(); ++i) {
    const int32_t end = i + 1 < table.packs.size() ? table.packs[i + 1].at : table.packed;
    largest = std::max(largest, end - table.packs[i].at);
  }
  return largest;
}

// A step for the interpreter, of records whose slots are those of the device. goes_on: with the sums of the one before.
CudaStep cuda_step(const ProgramStep& step, const ProgramOperand* operands, const std::vector<ProgramPack>& packs,
                   bool goes_on) {
  CudaStep made{};
  const auto value = [](const ProgramOperand& o) -> CudaValue {
    if (o.pairs >= 0) return {o.pairs, 0, pair_stride(o.width), o.width};
    return {o.slot, o.start, o.stride, o.width};
  };
  made.keeps = step.memory != kNoMemory;
  made.slot = step.floats ? step.slot : -1, made.stride = step.stride, made.pairs = step.pairs;
  made.width = step.width, made.depth = step.depth;
  made.bias = made.added = -1;
  made.number = step.number;
  const ProgramOperand *x = operands, *y = operands;
  if (step.op == ProgramOp::linear) {
    const ProgramPack& pack = packs[static_cast<size_t>(step.number)];
    made.weights = pack.at;
    made.turned = pack.kind == ProgramPackKind::turned;
    made.relu = step.finish == ProgramFinish::relu;
    made.sloped = step.finish == ProgramFinish::relu_slope;
    made.x_held = step.from_registers;
    made.holds = step.hands == ProgramHands::words;
    made.carries = step.hands == ProgramHands::sums;
    if (made.sloped) y = operands + step.taken - 1;
    if (step.taken > 1 + static_cast<int>(made.sloped) && !goes_on) {
      const ProgramOperand& added = operands[1];
      const bool bias = added.parameter && !added.spread;
      if (bias) made.bias = packs[static_cast<size_t>(added.slot)].at;
      if (!bias) made.added = step.first + 1;
    }
    const bool words = (made.x_held || x->pairs >= 0) && (!made.sloped || y->pairs >= 0) && !step.floats;
    made.op = words && made.added < 0 && !made.carries ? CudaOp::chain : CudaOp::linear;
  } else if (step.op == ProgramOp::outer) {
    made.op = CudaOp::outer;
    made.swapped = step.order != 1;
    (made.swapped ? x : y) = operands + 1;
  } else if (step.op == ProgramOp::columns) {
    made.op = CudaOp::columns;
  } else {
    made.op = step.op == ProgramOp::input    ? CudaOp::input
              : step.op == ProgramOp::output ? CudaOp::output
                                             : CudaOp::plain;
    made.added = step.first;
    return made;
  }
  made.x = value(*x), made.x_words = x->pairs >= 0;
  made.y = value(*y), made.y_words = y->pairs >= 0;
  return made;
}

// A step that adds up the columns of a gradient becomes a part of the outer product beside it, if that reads the same
// words on its right side.
void join_columns(std::vector<CudaStep>& steps) {
  for (size_t i = 0; i < steps.size(); ++i) {
    CudaStep& sum = steps[i];
    for (const size_t j : {i - 1, i + 1}) {
      if (sum.op != CudaOp::columns || sum.width == 0 || !sum.x_words || j >= steps.size()) continue;
      CudaStep& outer = steps[j];
      const bool same = std::memcmp(&outer.y, &sum.x, sizeof(CudaValue)) == 0;
      if (outer.op != CudaOp::outer || outer.bias >= 0 || !outer.swapped || !outer.x_words || !outer.y_words || !same)
        continue;
      outer.bias = sum.number;
      sum.width = 0;
    }
  }
}

// How a call is cut: rows and warps of a tile, rows of a task, blocks, at most so many tasks, and where what is in the
// workspace.
struct Cut {
  int own_rows, team, warps;
  bool spilled;
  int shared;
  int64_t task_rows, tasks, blocks;
  int64_t packed, partials, slots, bytes;
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
  const int64_t columns = std::max(1, Slots(table).columns());  // of sums that nothing is added to there are none
  // Teams of so many rows each that fit into a multiprocessor beside what as many blocks as are resident need.
  const auto fitting = [&](int rows) {
    return (device.multiprocessor_bytes - program_blocks(rows) * (kReservedBytes + kProgramStates)) /
           (4 * rows * columns);
  };
  // Warps of 32 rows read each weight once for all of them, if cells have so many and as many warps fit as there are
  // registers for; of 16 rows, if half as many do.
  const int64_t resident_tall = program_blocks(32) * program_warps(32);
  const bool tall = table.layout == ProgramLayout::tiles && fitting(32) >= resident_tall && n >= 32 * k;
  found.own_rows = tall ? 32 : 16;
  found.team = fitting(16) >= program_warps(16) ? 1 : kProgramTeam;
  found.spilled = fitting(16) < 2;
  // No more teams than there are rows for, in each cell and on every multiprocessor.
  const int resident = program_blocks(found.own_rows);
  const int64_t useful = n / (found.own_rows * std::max<int64_t>(1, std::max<int64_t>(k, device.multiprocessors)));
  int64_t teams = program_warps(found.own_rows) / found.team;
  // A tile reads and writes the partial sums once. So one block takes a multiprocessor where two would be smaller.
  const int64_t room = found.spilled ? teams : fitting(found.own_rows) / (table.partial > 0 ? 1 : resident);
  while (teams > 1 && teams > std::min(room, useful)) teams /= 2;
  const int64_t height = found.own_rows * teams;
  found.warps = static_cast<int>(found.team * teams);
  found.shared = static_cast<int>(kProgramStates + (found.spilled ? 0 : 4 * height * columns));
  // More than one tile where a multiprocessor has many.
  found.task_rows = height * std::clamp<int64_t>(n / (32 * height * device.multiprocessors), 1, 8);
  if (table.partial > 0) {
    // As many tasks as there are blocks at a time, of which each cell's last one is smaller, and few enough partials.
    const int64_t most_blocks = resident * program_warps(found.own_rows) / found.warps;
    const int64_t blocks = device.multiprocessor_bytes / (found.shared + kReservedBytes);
    const int64_t wave = std::clamp<int64_t>(blocks, 1, most_blocks) * device.multiprocessors;
    found.task_rows = std::max(height, ceil_div<int64_t>(n, wave > 2 * k ? wave - k : wave));
    found.task_rows = std::max(found.task_rows, ceil_div<int64_t>(n * table.partial, kPartialBytes / 4));
  }
  found.task_rows = ceil_div<int64_t>(found.task_rows, height) * height;
  found.tasks = n / found.task_rows + k;
  found.blocks =
      found.spilled ? std::min<int64_t>(found.tasks, int64_t{resident} * device.multiprocessors) : found.tasks;
  found.packed = aligned(4 * (k + 1));
  found.partials = found.packed + aligned(4 * k * table.packed);
  found.slots = found.partials + aligned(4 * found.tasks * table.partial);
  found.bytes = found.slots + (found.spilled ? aligned(4 * found.blocks * height * columns) : 0);
  return found;
}

template <typename Steps>
void launch(const CudaProgram& call, const Cut& found, int64_t partial, void* stream) {
  const auto kernel = program_kernel<Steps>;
  // Always the same, since what one host thread sets must do for the launch of another.
  VN_CUDA_CHECK(
      cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, current_device().shared_bytes));
  VN_LAUNCH(kernel, static_cast<unsigned>(found.blocks), static_cast<unsigned>(32 * found.warps), found.shared, stream,
            call, partial);
}

void launch_floats(const CudaProgram& call, const Cut& found, int64_t partial, void* stream) {
  if (found.spilled) return launch<FloatSteps<kProgramTeam, false>>(call, found, partial, stream);
  if (found.team > 1) return launch<FloatSteps<kProgramTeam, true>>(call, found, partial, stream);
  launch<FloatSteps<1, true>>(call, found, partial, stream);
}
template <typename Numbers>
void launch_tensors(const CudaProgram& call, const Cut& found, int64_t partial, void* stream) {
  if (found.spilled) return launch<TensorSteps<Numbers, 1, kProgramTeam, false>>(call, found, partial, stream);
  if (found.team > 1) return launch<TensorSteps<Numbers, 1, kProgramTeam, true>>(call, found, partial, stream);
  if constexpr (Numbers::kHalves) {
    if (found.own_rows == 32) return launch<TensorSteps<Numbers, 2, 1, true>>(call, found, partial, stream);
  }
  launch<TensorSteps<Numbers, 1, 1, true>>(call, found, partial, stream);
}

// Blocks that fill the device, if there is as much to do.
unsigned blocks_for(int64_t entries) {
  const int64_t most = kBlocksPerMultiprocessor * current_device().multiprocessors;
  return static_cast<unsigned>(std::max<int64_t>(1, std::min(most, ceil_div<int64_t>(entries, kThreads))));
}

}  // namespace

bool multiplies_halves_cuda(ProgramPrecision precision, void*) {
  return precision == ProgramPrecision::float16 ||
         (precision == ProgramPrecision::bfloat16 && current_device().capability >= 80);
}

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
      step.pairs = step.pairs < 0 ? step.pairs : slots.at(step.pairs, kNoMemory);
      step.stride += kProgramSkew;
    }
    step.memory = made && step.memory >= 0 ? memories[static_cast<size_t>(step.memory)] : kNoMemory;
  }
  for (ProgramOperand& operand : operands) {
    if (operand.parameter) continue;
    operand.slot = slots.at(operand.slot, operand.memory);
    operand.pairs = operand.pairs < 0 ? operand.pairs : slots.at(operand.pairs, kNoMemory);
    operand.stride += kProgramSkew;
  }
  std::vector<CudaStep> own_steps;
  for (const ProgramStep& step : steps) {
    const bool goes_on = !own_steps.empty() && own_steps.back().carries;
    own_steps.push_back(cuda_step(step, operands.data() + step.first, table.packs, goes_on));
  }
  join_columns(own_steps);
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
  write(at.own_steps, own_steps);
}

int64_t grouped_program_workspace_cuda(const Program& program, int64_t n, int64_t, int64_t k) {
  return cut(program, n, k).bytes;
}

void grouped_program_cuda(const Program& program, const unsigned char* code, const ProgramInputs& in,
                          const ProgramResults& results, ProgramPrecision precision, unsigned char* workspace,
                          void* stream) {
  const ProgramTable& table = program.table;
  if (current_device().capability < 80 && precision == ProgramPrecision::tf32) {
    precision = ProgramPrecision::float32;  // there are no such products
  }
  const Cut found = cut(program, in.n, in.k);
  const CodePlaces at = code_places(table);
  CudaProgram call{};
  call.code.packs = reinterpret_cast<const ProgramPack*>(code + at.packs);
  call.code.steps = reinterpret_cast<const ProgramStep*>(code + at.steps);
  call.code.operands = reinterpret_cast<const ProgramOperand*>(code + at.operands);
  call.code.sums = reinterpret_cast<const ProgramSum*>(code + at.sums);
  call.code.pack_count = static_cast<int32_t>(table.packs.size());
  call.code.step_count = static_cast<int32_t>(table.steps.size());
  call.code.sum_count = static_cast<int32_t>(table.sums.size());
  call.code.columns = Slots(table).columns();
  call.steps = reinterpret_cast<const CudaStep*>(code + at.own_steps);
  call.scatters = reinterpret_cast<const ProgramScatter*>(code + at.scatters);
  call.grids = reinterpret_cast<const HashEncoding*>(code + at.grids);
  call.rows = {in.offsets, in.order, in.ray_index, reinterpret_cast<int32_t*>(workspace), in.n, in.r, in.k};
  call.packed = reinterpret_cast<float*>(workspace + found.packed);
  call.packed_stride = table.packed;
  call.pack_parts = ceil_div(largest_pack(table), kPackPart);
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
  const int64_t packed = in.k * table.packed;
  VN_LAUNCH(program_prepare_kernel, blocks_for(std::max<int64_t>(in.n, packed)), kThreads, 0, stream, call, found.tasks,
            precision);
  if (in.n > 0 && in.k > 0) {
    switch (precision) {
      case ProgramPrecision::float32:
        launch_floats(call, found, table.partial, stream);
        break;
      case ProgramPrecision::tf32:
        launch_tensors<Tf32Numbers>(call, found, table.partial, stream);
        break;
      case ProgramPrecision::bfloat16:
        launch_tensors<HalfNumbers<true>>(call, found, table.partial, stream);
        break;
      case ProgramPrecision::float16:
        launch_tensors<HalfNumbers<false>>(call, found, table.partial, stream);
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
