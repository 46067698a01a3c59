// The interpreter of programs on CUDA. A task is a range of rows of one cell, and a block runs the tiles of its tasks
// one after the other. Each warp has 16 or 32 rows of a tile and runs the steps on them independently of the other
// warps. Only sums over rows are computed by all warps together, for all rows. If shared memory has space for the
// values of few rows only, four warps form a team: they have the same 16 rows and share the columns.
//
// Values are in shared memory, for each team [rows][stride] at their slot. They are float32 or, with 16-bit products,
// words of two 16-bit numbers if only products read them. A value that one product passes to the next stays in
// registers. If shared memory has space for fewer than two teams, values are in the workspace instead, with a part for
// each resident block.
//
// Layers: weights are packed once per call, in the layout and type of the products (program_cuda_product.h). Sums over
// rows: a thread has the same entries in every tile and adds to the task's partial in global memory. A second kernel
// adds up the partials of a cell in order, so results are deterministic. Only gradients of tables are added by atomic
// operations, in any order.
//
// Registers suffice for two resident blocks of 8 warps with 16 rows each, or three of 4 warps with 32 rows. Only
// products are inlined.
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
constexpr int64_t kBlocksPerMultiprocessor = 8;  // for kernels other than the interpreter
constexpr int kPackPart = 1024;                  // packed words that a block writes at a time
constexpr int64_t kReservedBytes = 1024;         // shared memory reserved by CUDA for each block
// The field `memory` of a step in the device's records: i >= 0 means look-up i, kNoMemory means none, and
// kNoMemory - 1 - i means scatter i.
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
  const Operand x = tile.operand(operands[0]), times = tile.operand(operands[step.operand_count - 1]);
  const float a = step.a, b = step.b;
  const int order = step.order;
  const bool alone = step.operand_count == 1;
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
  if (step.order == 1) {  // one operand writes each column
    for (int i = 0; i < step.operand_count; ++i) {
      const Operand x = tile.operand(operands[i]);
      const int place = operands[i].place;
      for_each_entry<Tile>(tile.rows(), operands[i].width,
                           [&](int row, int column) { to.put(row, place + column, x.at(row, column)); });
    }
    return;
  }
  for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {
    float sum = 0.0f;
    for (int i = 0; i < step.operand_count; ++i) {
      const int within = column - operands[i].place;
      if (within >= 0 && within < operands[i].width) sum += tile.operand(operands[i]).at(row, within);
    }
    to.put(row, column, sum);
  });
}

// Runs a step other than products, inputs and outputs.
template <typename Tile>
__device__ __noinline__ void plain_step(Tile tile, const ProgramStep& step) {
  const ProgramOperand* operands = tile.call.code.operands + step.first;
  const bool ready = step.op == ProgramOp::encode && tile.call.ready && step.memory >= 0;
  if (step.op == ProgramOp::encode && !(ready && tile.call.kept[step.memory] != nullptr)) {
    return encode_step(tile, step, operands);
  }
  if (step.op == ProgramOp::function) return function_step(tile, step, operands);
  const auto to = tile.target(step);
  switch (step.op) {
    case ProgramOp::binary: {
      const Operand x = tile.operand(operands[0]), y = tile.operand(operands[1]);
      return for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {
        to.put(row, column, binary(step.binary, x.at(row, column), y.at(row, column)));
      });
    }
    case ProgramOp::total: {
      const Operand x = tile.operand(operands[0]);
      return for_each_entry<Tile>(tile.rows(), step.width, [&](int row, int column) {
        float sum = 0.0f;
        for (int i = 0; i < step.number; ++i) sum += x.at(row, column * step.number + i);
        to.put(row, column, sum);
      });
    }
    case ProgramOp::move:
      return move_step(tile, step, operands);
    default: {  // a kept look-up is read
      const int64_t stride = tile.call.kept_strides[step.memory];
      const float* from = tile.call.kept[step.memory] + tile.begin() * stride;
      return for_each_entry<Tile>(tile.rows(), step.width,
                                  [&](int row, int column) { to.put(row, column, from[row * stride + column]); });
    }
  }
}

// Stores a look-up in the caller's memory, or adds the gradient of a look-up to the gradient of its table.
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

// Returns the cell of a task: the last cell whose first task is at most `task`. All lanes of a warp search together.
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

// Runs the steps from `i` up to the next sum over rows; a team computes these steps independently. Sets i to the index
// of the sum. Returns false if the program ends.
template <typename Steps, typename Tile>
__device__ __forceinline__ bool own_steps(const CudaProgram& call, const Tile& tile, int& i) {
  for (;; ++i) {
    CudaStep step = load_step(call.steps + i);
    if (step.sums()) return true;
    if (step.op == CudaOp::end) return false;
    if (Tile::kHalves && step.is(kClears) && (step.is(kPads) || tile.rows() < Tile::kRows)) clear_rest(tile, step);
    if (step.op == CudaOp::plain) {
      plain_step(tile, call.code.steps[step.number]);
    } else if (step.op == CudaOp::waves) {
      waves_step(tile, i);
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
        if (!step.is(kHolds)) break;
        Tile::sync();
        step = load_step(call.steps + ++i);
      }
    }
    Tile::sync();
    if (step.is(kKeeps)) {
      keep(tile, call.code.steps[step.number]);
      Tile::sync();
    }
  }
}
// Sets i to the index of the next sum, for a warp without rows, which runs no steps. Returns false if the program ends.
__device__ __forceinline__ bool next_sum(const CudaProgram& call, int& i) {
  for (;; ++i) {
    const CudaStep step = load_step(call.steps + i);
    if (step.sums() || step.op == CudaOp::end) return step.sums();
  }
}
template <typename Steps, typename Tile>
__device__ __forceinline__ int sums(const CudaProgram& call, const Tile& tile, int i) {
  for (;; ++i) {
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

// Returns the number of rows of a block's tile.
template <typename Tile>
__device__ __forceinline__ int tile_height() {
  return static_cast<int>(threads_again() / Tile::kWorkers) * Tile::kRows;
}
// Sets the row counts of a tile, if `left` rows of the task remain.
template <typename Tile>
__device__ __forceinline__ void cut_rows(TileState& state, int left) {
  const int height = tile_height<Tile>(), block_rows = left < height ? left : height;
  const int team_rows = block_rows - static_cast<int>(threadIdx.x / Tile::kWorkers) * Tile::kRows;
  state.left = left, state.all = block_rows;
  state.rows = team_rows < 0 ? 0 : team_rows < Tile::kRows ? team_rows : Tile::kRows;
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
      int i = 0;
      while (Tile::kTeam == 1 && tile.rows() == 0 ? next_sum(call, i) : own_steps<Steps>(call, tile, i)) {
        __syncthreads();
        i = sums<Steps>(call, tile, i);
        __syncthreads();
      }
    } while (next_tile<Tile>());
  }
}

// Computes first_task [k+1], the running sum of the cells' tasks, with one block. Decreasing offsets make cells
// overlap, which could give more tasks than the workspace has partials (`most`). So the indices are clamped to `most`,
// and the results of overlapping cells are undefined.
__device__ void number_tasks(const CudaRows& rows, int64_t task_rows, int64_t most) {
  VN_SHARED(sums, int64_t[kThreads / 32]);
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const auto clamped = [most](int64_t tasks) { return static_cast<int32_t>(tasks < most ? tasks : most); };
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
    int64_t offset = carry;
    for (int i = 0; i < kThreads / 32; ++i) {
      if (i < warp) offset += sums[i];
      carry += sums[i];
    }
    if (cell < rows.k) rows.first_task[cell] = clamped(offset + running - tasks);
    __syncthreads();  // all threads have read the sums
  }
  if (threadIdx.x == 0) rows.first_task[rows.k] = clamped(carry);
}

// Returns word `word` of a packed matrix, in the order of fragments or as [depth][outputs].
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

// Returns the order of an encoding's 16-bit columns; without octaves for `waves` -1, the order of the program.
__device__ __forceinline__ WaveOrder wave_order(const ProgramCode& code, int waves) {
  if (waves < 0) return {0, 0, 0};
  const ProgramPack& pack = code.packs[waves];
  return {pack.o, pack.i, pack.start};
}

// Packs the matrices and biases of each cell. A block packs one part of a matrix or bias at a time.
__device__ void pack_weights(const CudaProgram& call, ProgramPrecision precision) {
  const bool halves = precision == ProgramPrecision::bfloat16 || precision == ProgramPrecision::float16;
  const bool tensors = precision != ProgramPrecision::float32;
  const int deep = halves ? HalfNumbers<true>::kChunk : Tf32Numbers::kChunk, packs = call.code.pack_count;
  for (int64_t unit = blockIdx.x; unit < call.rows.k * packs * call.pack_parts; unit += gridDim.x) {
    const int part = static_cast<int>(unit % call.pack_parts);
    const int64_t rest = unit / call.pack_parts, cell = rest / packs;
    const ProgramPack pack = call.code.packs[rest % packs];
    const bool transposed = pack.kind == ProgramPackKind::transposed, vector = pack.kind == ProgramPackKind::vector;
    if (!transposed && !vector && pack.kind != ProgramPackKind::matrix) continue;
    const float* from =
        static_cast<const float*>(call.parameters[pack.parameter]) + cell * call.strides[pack.parameter] + pack.start;
    PackedMatrix matrix{from, transposed ? pack.i : 1, transposed ? 1 : pack.i, transposed ? pack.o : pack.width,
                        transposed ? pack.width : pack.o};
    if (vector) matrix = {from, 0, 1, 1, pack.width};
    matrix.waves = wave_order(call.code, pack.waves);
    const int outputs = padded(matrix.outputs, kProgramOutputs);
    // For tensor cores, the two bias columns of a lane are stored twice, because a lane has them in two rows.
    const int words = vector ? (tensors ? 2 : 1) * outputs : padded(matrix.depth, deep) * outputs / (halves ? 2 : 1);
    auto* const to = reinterpret_cast<uint32_t*>(call.packed) + cell * call.packed_stride + pack.at;
    const int last = words < (part + 1) * kPackPart ? words : (part + 1) * kPackPart;
    for (int word = part * kPackPart + static_cast<int>(threadIdx.x); word < last; word += kThreads) {
      const int column = vector && tensors ? word / 4 * 2 + word % 2 : word;
      to[word] = any_packed_word(matrix, vector ? ProgramPrecision::float32 : precision, outputs, column);
    }
  }
}

// Sets the outputs, and the look-up results that the caller keeps, to 0 for rows in no cell.
__device__ void clear_strays(const CudaProgram& call) {
  const CudaRows& rows = call.rows;
  const int64_t low = cell_begin(rows, 0), last = cell_begin(rows, rows.k), high = last < low ? low : last;
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads, strays = rows.n - (high - low);
  for (int o = 0; o < call.output_count; ++o) {
    const int width = call.output_widths[o];
    for (int64_t i = begin; i < strays * width; i += step) {
      const int64_t stray = i / width, row = source_row(rows, stray < low ? stray : stray + high - low);
      with_type(call.output_types[o], [&](auto type) {
        store_number<decltype(type)::value>(call.outputs[o], row * width + i - stray * width, 0.0f);
      });
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

// Prepares a call: packs the weights, and sets outputs of rows in no cell to 0. The first block also numbers the tasks.
__global__ void __launch_bounds__(kThreads)
    program_prepare_kernel(const VN_GRID_CONSTANT CudaProgram call, int64_t most, ProgramPrecision precision) {
  if (blockIdx.x == 0) number_tasks(call.rows, call.task_rows, most);
  pack_weights(call, precision);
  clear_strays(call);
}

// Adds up the partials of each cell. The grid is (k, blocks of a cell).
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
        const bool vector = sum.kind == ProgramSumKind::vector, transposed = sum.kind == ProgramSumKind::inputs_outputs;
        const int o = vector ? 0 : i / sum.i;
        int column = i - o * sum.i * !vector - sum.start;
        if (column < 0 || column >= sum.width) continue;
        if (sum.waves >= 0) column = wave_place(wave_order(code, sum.waves), column);
        const int at = sum.partial + (transposed ? column * sum.stride + o : o * sum.stride + column);
        const float* from = call.partials + at;
        int64_t task = first;
        for (; task + 8 <= last; task += 8) {  // eight loads in flight
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
  int capability;  // 86 for 8.6; at most the capability of the compiled code
};

// Returns the properties of the current device, cached per thread.
const Device& current_device() {
  thread_local int cached_device = -1;
  thread_local Device properties{};
  int device = 0;
  VN_CUDA_CHECK(cudaGetDevice(&device));
  if (cached_device == device) return properties;
  int major = 0, minor = 0;
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&properties.shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, device));
  properties.multiprocessor_bytes = properties.shared_bytes + kReservedBytes;
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&properties.multiprocessors, cudaDevAttrMultiProcessorCount, device));
  // Code compiled for a lower architecture than the device's uses only the instructions of the lower architecture.
  cudaFuncAttributes compiled{};
  VN_CUDA_CHECK(cudaFuncGetAttributes(&compiled, program_prepare_kernel));
  properties.capability = std::min(10 * major + minor, compiled.ptxVersion);
  cached_device = device;
  return properties;
}

// The positions of a program's slots in shared memory. Their rows are kProgramSkew longer than in the program, which
// moves all later slots. A value without a slot in the program, the gradient of a look-up, gets a slot after the
// others.
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

// The byte offset of each array of records in the code of a program, and the code's size.
struct CodePlaces {
  int64_t packs, steps, operands, sums, scatters, grids, own_steps, bytes;
};
int64_t aligned(int64_t bytes) { return ceil_div<int64_t>(bytes, 256) * 256; }
CodePlaces code_places(const ProgramTable& table) {
  CodePlaces at{};
  const auto after = [](int64_t place, const auto& records) {
    return place + aligned(static_cast<int64_t>(records.size() * sizeof(records[0])));
  };
  at.steps = after(at.packs, table.packs);
  at.operands = after(at.steps, table.steps);
  at.sums = after(at.operands, table.operands);
  at.scatters = after(at.sums, table.sums);
  at.grids = after(at.scatters, table.scatters);
  at.own_steps = at.grids + aligned(static_cast<int64_t>(table.grids.size() * sizeof(HashEncoding)));
  at.bytes = at.own_steps + aligned(static_cast<int64_t>((table.steps.size() + 1) * sizeof(CudaStep)));
  return at;
}

// Returns an upper bound on the words of a pack: the largest distance from the start of a pack to the next one.
int32_t largest_pack(const ProgramTable& table) {
  int32_t largest = 1;
  for (size_t i = 0; i < table.packs.size(); ++i) {
    const int32_t end = i + 1 < table.packs.size() ? table.packs[i + 1].at : table.packed;
    largest = std::max(largest, end - table.packs[i].at);
  }
  return largest;
}

// Returns a step as the interpreter reads it. `step` and `operands` must already have the positions of the slots on the
// device (class Slots). goes_on: the step adds to the sums of the previous step.
CudaStep cuda_step(const ProgramStep& step, int32_t index, const ProgramOperand* operands,
                   const std::vector<ProgramPack>& packs, bool goes_on) {
  CudaStep result{};
  const auto value = [](const ProgramOperand& o) -> CudaValue {
    if (o.pairs >= 0) return {o.pairs, 0, pair_stride(o.width), o.width};
    return {o.slot, o.start, o.stride, o.width};
  };
  result.set(kKeeps, step.memory != kNoMemory);
  result.slot = step.floats ? step.slot : -1, result.stride = step.stride, result.pairs = step.pairs;
  result.width = step.width, result.depth = step.depth;
  result.bias = result.added = -1;
  const bool numbered = step.op == ProgramOp::input || step.op == ProgramOp::output || step.op == ProgramOp::outer ||
                        step.op == ProgramOp::columns;
  result.number = numbered ? step.number : index;
  const ProgramOperand *x = operands, *y = operands;
  if (step.op == ProgramOp::linear) {
    const ProgramPack& pack = packs[static_cast<size_t>(step.number)];
    result.weights = pack.at;
    result.set(kTransposed, pack.kind == ProgramPackKind::transposed);
    result.set(kRelu, step.finish == ProgramFinish::relu);
    result.set(kSloped, step.finish == ProgramFinish::relu_slope);
    result.set(kXHeld, step.from_registers);
    result.set(kHolds, step.to_registers == ProgramToRegisters::words);
    result.set(kCarries, step.to_registers == ProgramToRegisters::sums);
    if (result.is(kSloped)) y = operands + step.operand_count - 1;
    if (step.operand_count > 1 + static_cast<int>(result.is(kSloped)) && !goes_on) {
      const ProgramOperand& added = operands[1];
      const bool bias = added.parameter && !added.spread;
      if (bias) result.bias = packs[static_cast<size_t>(added.slot)].at;
      if (!bias) result.added = step.first + 1;
    }
    const bool words = (result.is(kXHeld) || x->pairs >= 0) && (!result.is(kSloped) || y->pairs >= 0) && !step.floats;
    result.op = words && result.added < 0 && !result.is(kCarries) ? CudaOp::chain : CudaOp::linear;
  } else if (step.op == ProgramOp::outer) {
    result.op = CudaOp::outer;
    result.set(kSwapped, step.order != 1);
    (result.is(kSwapped) ? x : y) = operands + 1;
  } else if (step.op == ProgramOp::columns) {
    result.op = CudaOp::columns;
  } else if (step.op == ProgramOp::output) {
    result.op = CudaOp::output;
    if (x->parameter || x->spread) result.added = step.first;
  } else {
    const bool waves = step.op == ProgramOp::encode && step.order == 0 &&
                       (step.encoding == ProgramEncoding::frequency || step.encoding == ProgramEncoding::integrated);
    result.op = waves ? CudaOp::waves : step.op == ProgramOp::input ? CudaOp::input : CudaOp::plain;
    result.set(kDamped, step.encoding == ProgramEncoding::integrated);
    result.set(kClears, step.pairs >= 0 && (result.op != CudaOp::input || step.width > kFewColumns));
    const int32_t written = waves ? padded(step.width, 2) : step.width;  // waves are whole words
    result.set(kPads, written < 2 * pair_words(step.width));
    if (!waves) return result;
  }
  result.x = value(*x), result.set(kXWords, x->pairs >= 0);
  result.y = value(*y), result.set(kYWords, y->pairs >= 0);
  return result;
}

// Merges the column sums of a gradient into a neighbouring outer product whose right operand is the same gradient, read
// from the same words.
void join_columns(std::vector<CudaStep>& steps) {
  for (size_t i = 0; i < steps.size(); ++i) {
    const CudaStep sum = steps[i];
    if (sum.op != CudaOp::columns || !sum.is(kXWords)) continue;
    for (const size_t j : {i - 1, i + 1}) {
      if (j >= steps.size()) continue;
      CudaStep& outer = steps[j];
      const bool same = std::memcmp(&outer.y, &sum.x, sizeof(CudaValue)) == 0;
      if (outer.op != CudaOp::outer || outer.bias >= 0 || !outer.is(kSwapped) || !outer.is(kXWords) ||
          !outer.is(kYWords) || !same)
        continue;
      outer.bias = sum.number;
      steps.erase(steps.begin() + static_cast<std::ptrdiff_t>(i--));
      break;
    }
  }
}

// The launch plan of a call: rows of a team, warps of a team and of a block, rows of a task, the most tasks, blocks,
// and the offsets in the workspace.
struct LaunchPlan {
  int own_rows, team, warps;
  bool spilled;
  int shared;
  int64_t task_rows, tasks, blocks;
  int64_t packed, partials, slots, bytes;
};

LaunchPlan plan_launch(const Program& program, int64_t n, int64_t k) {
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
  LaunchPlan result{};
  const int64_t columns = std::max(1, Slots(table).columns());  // a program whose sums stay 0 has no columns
  // Returns how many teams of `rows` rows fit into a multiprocessor, in addition to the fixed memory of its resident
  // blocks.
  const auto fitting = [&](int rows) {
    return (device.multiprocessor_bytes - program_blocks(rows) * (kReservedBytes + kProgramStates)) /
           (4 * rows * columns);
  };
  // Warps have 32 rows, and read each weight once for all of them, if cells have enough rows and the values of all
  // resident warps fit. Otherwise warps have 16 rows. If not even the values of half the resident warps fit, the warps
  // of a team share their 16 rows.
  const int64_t resident_tall = program_blocks(32) * program_warps(32);
  const bool tall = table.layout == ProgramLayout::tiles && fitting(32) >= resident_tall && n >= 32 * k;
  result.own_rows = tall ? 32 : 16;
  result.team = fitting(16) >= program_warps(16) ? 1 : kProgramTeam;
  result.spilled = fitting(16) < 2;
  // There must be enough rows for all teams, in each cell and on every multiprocessor.
  const int resident = program_blocks(result.own_rows);
  const int64_t useful = n / (result.own_rows * std::max<int64_t>(1, std::max<int64_t>(k, device.multiprocessors)));
  int64_t teams = program_warps(result.own_rows) / result.team;
  // Each tile reads and writes the partial sums once, so with partials one large block per multiprocessor is better
  // than two small ones.
  const int64_t room = result.spilled ? teams : fitting(result.own_rows) / (table.partial > 0 ? 1 : resident);
  while (teams > 1 && teams > std::min(room, useful)) teams /= 2;
  const int64_t height = result.own_rows * teams;
  result.warps = static_cast<int>(result.team * teams);
  result.shared = static_cast<int>(kProgramStates + (result.spilled ? 0 : 4 * height * columns));
  // A task has several tiles if each multiprocessor has many tiles.
  result.task_rows = height * std::clamp<int64_t>(n / (32 * height * device.multiprocessors), 1, 8);
  if (table.partial > 0) {
    // At most one task per resident block, counting a smaller last task of each cell, and at most kPartialBytes of
    // partials.
    const int64_t most_blocks = resident * program_warps(result.own_rows) / result.warps;
    const int64_t blocks = device.multiprocessor_bytes / (result.shared + kReservedBytes);
    const int64_t wave = std::clamp<int64_t>(blocks, 1, most_blocks) * device.multiprocessors;
    result.task_rows = std::max(height, ceil_div<int64_t>(n, wave > 2 * k ? wave - k : wave));
    result.task_rows = std::max(result.task_rows, ceil_div<int64_t>(n * table.partial, kPartialBytes / 4));
  }
  result.task_rows = ceil_div<int64_t>(result.task_rows, height) * height;
  result.tasks = n / result.task_rows + k;
  result.blocks =
      result.spilled ? std::min<int64_t>(result.tasks, int64_t{resident} * device.multiprocessors) : result.tasks;
  result.packed = aligned(4 * (k + 1));
  result.partials = result.packed + aligned(4 * k * table.packed);
  result.slots = result.partials + aligned(4 * result.tasks * table.partial);
  result.bytes = result.slots + (result.spilled ? aligned(4 * result.blocks * height * columns) : 0);
  return result;
}

template <typename Steps>
void launch(const CudaProgram& call, const LaunchPlan& plan, int64_t partial, void* stream) {
  const auto kernel = program_kernel<Steps>;
  // The limit is always the same, because a launch may use the limit that another host thread has set.
  VN_CUDA_CHECK(
      cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, current_device().shared_bytes));
  VN_LAUNCH(kernel, static_cast<unsigned>(plan.blocks), static_cast<unsigned>(32 * plan.warps), plan.shared, stream,
            call, partial);
}

void launch_floats(const CudaProgram& call, const LaunchPlan& plan, int64_t partial, void* stream) {
  if (plan.spilled) return launch<FloatSteps<kProgramTeam, false>>(call, plan, partial, stream);
  if (plan.team > 1) return launch<FloatSteps<kProgramTeam, true>>(call, plan, partial, stream);
  launch<FloatSteps<1, true>>(call, plan, partial, stream);
}
template <typename Numbers>
void launch_tensors(const CudaProgram& call, const LaunchPlan& plan, int64_t partial, void* stream) {
  if (plan.spilled) return launch<TensorSteps<Numbers, 1, kProgramTeam, false>>(call, plan, partial, stream);
  if (plan.team > 1) return launch<TensorSteps<Numbers, 1, kProgramTeam, true>>(call, plan, partial, stream);
  if constexpr (Numbers::kHalves) {
    if (plan.own_rows == 32) return launch<TensorSteps<Numbers, 2, 1, true>>(call, plan, partial, stream);
  }
  launch<TensorSteps<Numbers, 1, 1, true>>(call, plan, partial, stream);
}

// Returns the blocks that fill the device, or fewer if there are few entries.
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
  // For each array of the program (look-up result, gradient or output), the value of `memory` in the device's records
  // (see kNoMemory). It is kNoMemory for outputs, since only their output steps write them.
  std::vector<int32_t> memories(table.memories.size(), kNoMemory);
  for (size_t i = 0; i < table.lookups.size(); ++i) {
    memories[static_cast<size_t>(table.lookups[i].memory)] = static_cast<int32_t>(i);
  }
  for (size_t i = 0; i < table.scatters.size(); ++i) {
    memories[static_cast<size_t>(table.scatters[i].memory)] = kNoMemory - 1 - static_cast<int32_t>(i);
  }
  for (ProgramStep& step : steps) {
    const bool makes_value = Slots::makes_value(step);
    if (makes_value) {
      step.slot = slots.at(step.slot, step.memory);
      step.pairs = step.pairs < 0 ? step.pairs : slots.at(step.pairs, kNoMemory);
      step.stride += kProgramSkew;
    }
    step.memory = makes_value && step.memory >= 0 ? memories[static_cast<size_t>(step.memory)] : kNoMemory;
  }
  for (ProgramOperand& operand : operands) {
    if (operand.parameter) continue;
    operand.slot = slots.at(operand.slot, operand.memory);
    operand.pairs = operand.pairs < 0 ? operand.pairs : slots.at(operand.pairs, kNoMemory);
    operand.stride += kProgramSkew;
  }
  std::vector<CudaStep> own_steps;
  for (size_t i = 0; i < steps.size(); ++i) {
    const bool goes_on = !own_steps.empty() && own_steps.back().is(kCarries);
    const ProgramOperand* first = operands.data() + steps[i].first;
    own_steps.push_back(cuda_step(steps[i], static_cast<int32_t>(i), first, table.packs, goes_on));
  }
  join_columns(own_steps);
  own_steps.emplace_back().op = CudaOp::end;
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
  return plan_launch(program, n, k).bytes;
}

void grouped_program_cuda(const Program& program, const unsigned char* code, const ProgramInputs& in,
                          const ProgramResults& results, ProgramPrecision precision, unsigned char* workspace,
                          void* stream) {
  const ProgramTable& table = program.table;
  if (current_device().capability < 80 && precision == ProgramPrecision::tf32) {
    precision = ProgramPrecision::float32;  // no tf32 before sm_80
  }
  const LaunchPlan plan = plan_launch(program, in.n, in.k);
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
  call.packed = reinterpret_cast<float*>(workspace + plan.packed);
  call.packed_stride = table.packed;
  call.pack_parts = ceil_div(largest_pack(table), kPackPart);
  call.partials = reinterpret_cast<float*>(workspace + plan.partials);
  call.spilled = reinterpret_cast<float*>(workspace + plan.slots);
  call.task_rows = plan.task_rows;
  for (size_t i = 0; i < table.inputs.size(); ++i) {
    call.inputs[i] = in.inputs[i];
    call.input_types[i] = static_cast<uint8_t>(in.input_types[i]);
    call.transposed[i] = in.transposed[i] != 0;
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
  VN_LAUNCH(program_prepare_kernel, blocks_for(std::max<int64_t>(in.n, packed)), kThreads, 0, stream, call, plan.tasks,
            precision);
  if (in.n > 0 && in.k > 0) {
    switch (precision) {
      case ProgramPrecision::float32:
        launch_floats(call, plan, table.partial, stream);
        break;
      case ProgramPrecision::tf32:
        launch_tensors<Tf32Numbers>(call, plan, table.partial, stream);
        break;
      case ProgramPrecision::bfloat16:
        launch_tensors<HalfNumbers<true>>(call, plan, table.partial, stream);
        break;
      case ProgramPrecision::float16:
        launch_tensors<HalfNumbers<false>>(call, plan, table.partial, stream);
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
