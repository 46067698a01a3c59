// Definitions shared by the kernels of programs: a call, the rows of its cells, and a tile.
//
// The map from blocks to rows of cells is made on the device, so that the host does not read the offsets. The host has
// not validated offsets, order and ray_index, so each use clamps them to valid indices.
#pragma once

#include <type_traits>

#include "common/cuda_wrappers.h"
#include "common/index_maps.h"
#include "encoding/hash_encode_math.h"
#include "network/program.h"

namespace voronerf {

// The warps of a block and the resident blocks of a multiprocessor, by the rows of a team: 16 warps with 128 registers
// per thread, or 12 with 168.
VN_HD constexpr int program_warps(int rows) { return rows == 32 ? 4 : 8; }
VN_HD constexpr int program_blocks(int rows) { return rows == 32 ? 3 : 2; }
constexpr int kProgramTeam = 4;          // warps of a team that share rows, if the values of few rows fit
constexpr int kProgramWide = kMostHeld;  // columns of a product that a warp computes at a time
constexpr int kProgramSkew = 4;          // padding of rows of slots, in floats beyond a multiple of 16
constexpr int kProgramOutputs = 32;      // packed weights and biases are padded with 0 to a multiple of this
constexpr int kProgramMost = 64;         // limit for tensors of a kind: kernel arguments have at most 4 KiB
constexpr int kProgramLookups = 16;

struct CudaRows {
  const int32_t *offsets, *order, *ray_index;  // order and ray_index may be null
  int32_t* first_task;                         // [k+1], in the workspace
  int64_t n, r, k;
};

// An operand of a product: columns from `start` on of the value at a slot.
struct CudaValue {
  int32_t slot, start, stride, columns;
};
// The kinds of steps. chain: a linear step that reads and writes only words (pairs of 16-bit numbers). waves: an
// encoding by octaves. The last step is `end`.
enum class CudaOp : int32_t { plain, input, output, linear, chain, waves, outer, columns, end };
// Properties of a step.
enum CudaFlag : uint32_t {
  kKeeps = 1,  // the result is also stored for the caller, or added to the gradient of a table
  kRelu = 2,
  kSloped = 4,
  kTransposed = 8,
  kXWords = 16,
  kYWords = 32,
  kSwapped = 64,   // outer: y, not x, is the gradient
  kXHeld = 128,    // x is in registers
  kHolds = 256,    // the result stays in registers
  kCarries = 512,  // the next step adds to the sums
  kDamped = 1024,  // waves: damped by variances
  kClears = 2048,  // clear_rest clears rows of words without a sample
  kPads = 4096,    // clear_rest also clears columns, for steps that do not write the padding of a row
};
// A step as the interpreter reads it, in five loads: the fields of the step, its operands and packs. Plain steps use
// only `op`, `number`, `flags` and the fields of the result.
struct alignas(16) CudaStep {
  CudaValue x;
  // Offsets in the packed parameters; -1: none. For outer, bias is the offset of the sums of y's columns in the
  // partial, or -1.
  int32_t weights, bias;
  int32_t depth, width;  // output: `depth` is the first destination column. waves: `depth` is the number of octaves
  CudaValue y;           // linear: the value of the ReLU whose slope is applied. outer: right operand
  int32_t slot, stride;  // of the result as floats (slot -1: none); outer: `stride` is the row of the sum
  int32_t pairs;         // slot of the result as 16-bit words, or -1
  int32_t added;         // index of an added operand, or -1; output: of an operand that is not in a slot, or -1
  int32_t number;        // input, output: its index. outer, columns: offset in the partial. else: index of the step
  CudaOp op;
  uint32_t flags;
  __host__ __device__ __forceinline__ bool is(CudaFlag flag) const { return (flags & flag) != 0; }
  void set(CudaFlag flag, bool value) { flags |= value ? flag : 0u; }
  __device__ __forceinline__ bool sums() const { return op == CudaOp::outer || op == CudaOp::columns; }
};
static_assert(sizeof(CudaStep) == 80, "five loads");

// Loads a whole step at once, so that a thread does not wait for each field separately.
__device__ __forceinline__ CudaStep load_step(const CudaStep* from) {
  CudaStep step;
  uint4 parts[5];
#pragma unroll
  for (int i = 0; i < 5; ++i) parts[i] = load_constant(reinterpret_cast<const uint4*>(from) + i);
  memcpy(&step, parts, sizeof step);
  return step;
}

// The arguments of a call. All pointers, including the pointers in `code`, are to device memory.
struct CudaProgram {
  ProgramCode code;
  const CudaStep* steps;
  const HashEncoding* grids;  // without tables
  const ProgramScatter* scatters;
  CudaRows rows;
  float *partials, *spilled, *packed;  // in the workspace
  int64_t task_rows, packed_stride;    // packed_stride: floats from one cell's packs to the next
  const void *inputs[kProgramMost], *parameters[kProgramMost];
  void* outputs[kProgramMost];
  float* sums[kProgramMost];
  int64_t strides[kProgramMost];  // from one cell's parameter to the next
  float* kept[kProgramLookups];   // [n][stride] of each look-up, or null
  int32_t kept_strides[kProgramLookups], output_widths[kProgramMost];
  uint8_t input_types[kProgramMost], parameter_types[kProgramMost], output_types[kProgramMost];
  bool transposed[kProgramMost], rays[kProgramMost];  // inputs
  int32_t output_count, lookup_count, pack_parts;
  bool ready;  // kept look-ups are filled
};
static_assert(sizeof(CudaProgram) <= 4000, "kernel arguments hold 4 KiB");

// Returns the nearest index in [0, n).
__device__ __forceinline__ int64_t index_within(int64_t index, int64_t n) {
  return index < 0 ? 0 : index < n ? index : n - 1;
}
__device__ __forceinline__ int64_t source_row(const CudaRows& rows, int64_t row) {
  return rows.order == nullptr ? row : index_within(rows.order[row], rows.n);
}

// `cell_begin` returns the first row of a cell, `cell_rows` the number of its rows.
__device__ __forceinline__ int64_t cell_begin(const CudaRows& rows, int64_t cell) {
  const int64_t first = rows.offsets[cell];
  return first < 0 ? 0 : first > rows.n ? rows.n : first;
}
__device__ __forceinline__ int64_t cell_rows(const CudaRows& rows, int64_t cell) {
  const int64_t count = cell_begin(rows, cell + 1) - cell_begin(rows, cell);
  return count < 0 ? 0 : count;
}

// Calls run(type) with the type of numbers in memory as a compile-time constant, and returns its result.
template <typename Run>
__device__ __forceinline__ auto with_type(int type, const Run& run) {
  switch (static_cast<TableType>(type)) {
    case TableType::float32:
      return run(std::integral_constant<TableType, TableType::float32>());
    case TableType::bfloat16:
      return run(std::integral_constant<TableType, TableType::bfloat16>());
    default:
      return run(std::integral_constant<TableType, TableType::float16>());
  }
}
template <TableType kType>
using InMemory = std::conditional_t<kType == TableType::float32, float, uint16_t>;
// Loads and stores of numbers of a type.
template <TableType kType>
__device__ __forceinline__ float load_number(const void* from, int64_t at) {
  if constexpr (kType == TableType::float32) return static_cast<const float*>(from)[at];
  return unpack_half<kType == TableType::bfloat16>(static_cast<const uint16_t*>(from)[at]);
}
template <TableType kType>
__device__ __forceinline__ void store_number(void* to, int64_t at, float x) {
  if constexpr (kType == TableType::float32) {
    static_cast<float*>(to)[at] = x;
  } else {
    static_cast<uint16_t*>(to)[at] = static_cast<uint16_t>(pack_halves<kType == TableType::bfloat16>(x, 0.0f));
  }
}

// One row of an input, in the caller's order.
struct InputRow {
  const void* data;
  int64_t at, apart;  // offset of the first column, and stride of columns
  int type;
  template <TableType kType>
  __device__ __forceinline__ float column(int i) const {
    return data == nullptr ? 0.0f : load_number<kType>(data, at + i * apart);
  }
  __device__ __forceinline__ float column(int i) const {
    return with_type(type, [&](auto type) { return column<decltype(type)::value>(i); });
  }
};
__device__ __forceinline__ InputRow input_row(const CudaProgram& call, int input, int width, int64_t source) {
  int64_t row = source, rows = call.rows.n;
  const void* data = call.inputs[input];
  if (call.rays[input]) {
    rows = call.rows.r;
    if (rows == 0) return {nullptr, 0, 0, 0};
    row = index_within(call.rows.ray_index[source], rows);
  }
  const bool transposed = call.transposed[input];
  return {data, transposed ? row : row * width, transposed ? rows : 1, call.input_types[input]};
}

// The layout of a value as 16-bit numbers: pair_words returns the number of words of a row, padded with 0; pair_stride
// returns the number of words from one row to the next.
VN_HD constexpr int padded(int width, int to) { return ceil_div(width, to) * to; }
VN_HD constexpr int pair_words(int width) { return padded(width, 2 * kGranule) / 2; }
VN_HD constexpr int pair_stride(int width) { return pair_words(width) + kProgramSkew; }

// Columns of a value or of a cell's parameter vector.
struct Operand {
  const float* data;
  int stride;
  bool spread;
  __device__ __forceinline__ float at(int row, int column) const { return data[row * stride + (spread ? 0 : column)]; }
};

// The destination of a step's result: floats in a slot, 16-bit numbers in another slot, or both.
template <bool kBfloat16>
struct Target {
  float* floats;
  uint16_t* halves;
  int stride, halves_stride;
  bool has_floats, has_halves;
  __device__ __forceinline__ void put(int row, int column, float x) const {
    if (has_floats) floats[row * stride + column] = x;
    if (has_halves) put_half(row, column, x);
  }
  __device__ __forceinline__ void put_half(int row, int column, float x) const {
    halves[row * halves_stride + column] = static_cast<uint16_t>(pack_halves<kBfloat16>(x, 0.0f));
  }
};

// The type of values that a kernel's products read.
enum class ProgramNumbers { floats, bfloat16, float16 };

// The current tile of a block, and the rows of a warp's team in it. Each warp has a copy in shared memory: registers
// are needed for sums.
struct TileState {
  const float* weights;  // packed parameters of the cell
  int64_t partial;       // offset of the task's partial
  int32_t cell, begin;   // begin: the team's first row
  int32_t rows, all;     // rows with a sample, of the team and of the block
  int32_t left;          // remaining rows of the task, including this tile
  int32_t fill;          // 1 in the first tile of a task
};
constexpr int kProgramStates = 512;  // bytes of all states, before the slots

// A value of a team is [kRows][stride] at its slot. Rows without a sample are undefined as floats, and 0 as 16-bit
// numbers. kShared: the slots are in the block's shared memory.
template <int kOwnRows, int kWarps, bool kShared, ProgramNumbers kNumbers>
struct ProgramTile {
  static constexpr int kRows = kOwnRows, kTeam = kWarps, kWorkers = 32 * kTeam;
  static constexpr bool kHalves = kNumbers != ProgramNumbers::floats, kBfloat16 = kNumbers == ProgramNumbers::bfloat16;
  const CudaProgram& call;

  static __device__ __forceinline__ TileState& state() {
    static_assert(program_warps(kRows) * sizeof(TileState) <= kProgramStates);
    VN_DYN_SHARED(TileState, states);
    return states[thread_again() / 32];
  }
  __device__ __forceinline__ int rows() const { return state().rows; }
  __device__ __forceinline__ int all() const { return state().all; }
  __device__ __forceinline__ int cell() const { return state().cell; }
  __device__ __forceinline__ int begin() const { return state().begin; }
  __device__ __forceinline__ bool fill() const { return state().fill != 0; }
  __device__ __forceinline__ float* partial() const { return call.partials + state().partial; }
  // Returns the distance in floats from the slots of a team to the slots of the next team.
  __device__ __forceinline__ int pitch() const { return call.code.columns * kRows; }

  // `worker` returns the index of a thread in its team, `warp` the index of its warp.
  static __device__ __forceinline__ int worker() { return static_cast<int>(thread_again() % kWorkers); }
  static __device__ __forceinline__ int warp() { return worker() / 32; }
  // Makes the writes of a team visible to all its threads.
  static __device__ __forceinline__ void sync() {
    if constexpr (kTeam == 1) {
      __syncwarp();
    } else {
      __syncthreads();  // all teams run the same steps
    }
  }

  // `slot` returns a slot of the thread's team, `first_slot` a slot of the block's first team.
  __device__ __forceinline__ float* slot(int32_t columns) const {
    return first_slot(columns) + static_cast<int>(thread_again() / kWorkers) * pitch();
  }
  __device__ __forceinline__ float* first_slot(int32_t columns) const {
    if constexpr (kShared) {
      VN_DYN_SHARED(float, shared);
      return shared + kProgramStates / 4 + columns * kRows;
    } else {
      const int height = static_cast<int>(threads_again() / kWorkers) * kRows;
      return call.spilled + int64_t{blockIdx.x} * call.code.columns * height + columns * kRows;
    }
  }
  // Returns a float32 parameter. Only tables may have other types.
  __device__ __forceinline__ const float* parameter(const ProgramPack& pack) const {
    return static_cast<const float*>(call.parameters[pack.parameter]) + cell() * call.strides[pack.parameter] +
           pack.start;
  }
  __device__ __forceinline__ const float* packed(int32_t at) const { return state().weights + at; }
  __device__ __forceinline__ Target<kBfloat16> target(const ProgramStep& step) const {
    return target(step.slot, step.stride, step.pairs, step.width, step.floats);
  }
  __device__ __forceinline__ Target<kBfloat16> target(const CudaStep& step) const {
    return target(step.slot, step.stride, step.pairs, step.width, step.slot >= 0);
  }
  __device__ __forceinline__ Operand value(const ProgramOperand& o) const {
    return {slot(o.slot) + o.start, o.stride, o.spread};
  }
  __device__ __forceinline__ Operand operand(const ProgramOperand& o) const {
    if (o.parameter) return {parameter(call.code.packs[o.slot]), 0, o.spread};
    return value(o);
  }

 private:
  __device__ __forceinline__ Target<kBfloat16> target(int at, int stride, int pairs, int width, bool floats) const {
    const bool has_halves = kHalves && pairs >= 0;
    auto* halves = reinterpret_cast<uint16_t*>(slot(has_halves ? pairs : 0));
    return {slot(floats ? at : 0), halves, stride, 2 * pair_stride(width), floats, has_halves};
  }
};

__device__ __forceinline__ int lane_again() { return static_cast<int>(thread_again() % 32); }

// Calls visit(row, column) for all entries, distributed over a team. Neighbouring threads have neighbouring columns,
// and a thread iterates over the rows of a column, so that terms of the column are computed once.
template <typename Tile, typename Visit>
__device__ __forceinline__ void for_each_entry(int rows, int width, const Visit& visit) {
  const int shift = width > 16 ? 5 : width > 1 ? 32 - __clz(width - 1) : 0;
  const int worker = Tile::worker(), across = 1 << shift;
  for (int column = worker & (across - 1); column < width; column += across) {
    for (int row = worker >> shift; row < rows; row += Tile::kWorkers >> shift) visit(row, column);
  }
}

// Computes partial[j] += the sum of column j over the block's rows. Four lanes share a column and add two neighbouring
// rows at a time.
template <typename Tile>
__device__ __forceinline__ void sum_columns(const Tile& tile, const CudaStep& step) {
  const float* const values = tile.first_slot(step.x.slot) + step.x.start;
  const int lane = lane_again(), warps = static_cast<int>(threads_again() / 32), all = tile.all();
  for (int first = 8 * static_cast<int>(thread_again() / 32); first < step.width; first += 8 * warps) {
    const int column = first + lane % 8;
    const float* x = values;
    float sum = 0.0f;
    for (int left = all; left > 0 && column < step.width; left -= Tile::kRows, x += tile.pitch()) {
      const int rows = left < Tile::kRows ? left : Tile::kRows;
      for (int row = 2 * (lane / 8); row < rows; row += 8) {
        sum += x[row * step.x.stride + column];
        if (row + 1 < rows) sum += x[(row + 1) * step.x.stride + column];
      }
    }
    sum += __shfl_xor_sync(kAllLanes, sum, 8);
    sum += __shfl_xor_sync(kAllLanes, sum, 16);
    if (lane >= 8 || column >= step.width) continue;
    float& entry = tile.partial()[step.number + column];
    entry = (tile.fill() ? 0.0f : entry) + sum;
  }
}

// Clears the padding rows and columns of a value as 16-bit numbers.
template <typename Tile>
__device__ __forceinline__ void clear_rest(const Tile& tile, const CudaStep& step) {
  const auto to = tile.target(step);
  auto* const words = reinterpret_cast<uint32_t*>(to.halves);
  const int width = step.width, stride = to.halves_stride / 2, first_padding = (width + 1) / 2,
            last = pair_words(width);
  const int row = Tile::worker(), rows = tile.rows();
  if (width % 2 != 0 && step.op != CudaOp::waves && row < rows) to.put_half(row, width, 0.0f);
  if (first_padding < last) {
    for_each_entry<Tile>(tile.rows(), last - first_padding,
                         [&](int row, int word) { words[row * stride + first_padding + word] = 0; });
  }
  if (rows < Tile::kRows) {
    for_each_entry<Tile>(Tile::kRows - rows, last, [&](int row, int word) { words[(rows + row) * stride + word] = 0; });
  }
}

// Inputs and outputs with at most this many columns have one thread per row, which resolves the row's index once, and
// requests all numbers before it waits for the first.
constexpr int kFewColumns = 8;

// Calls visit(i) for the first `width` of kFewColumns.
template <typename Visit>
__device__ __forceinline__ void for_few(int width, const Visit& visit) {
#pragma unroll
  for (int i = 0; i < kFewColumns / 2; ++i) {
    if (i < width) visit(i);
  }
  if (width <= kFewColumns / 2) return;
#pragma unroll
  for (int i = kFewColumns / 2; i < kFewColumns; ++i) {
    if (i < width) visit(i);
  }
}
__device__ __forceinline__ void load_few(float (&values)[kFewColumns], const InputRow& from, int width) {
  if (from.data == nullptr) return;
  if (from.apart != 1) {  // float32
    const float* at = static_cast<const float*>(from.data) + from.at;
    return for_few(width, [&](int i) {
      values[i] = *at;
      at += from.apart;
    });
  }
  with_type(from.type, [&](auto type) {
    constexpr TableType kType = decltype(type)::value;
    const auto* const at = static_cast<const InMemory<kType>*>(from.data) + from.at;
    for_few(width, [&](int i) { values[i] = load_number<kType>(at, i); });
  });
}

template <typename Tile>
__device__ __forceinline__ void input_step(const Tile& tile, const CudaStep& step) {
  const CudaProgram& call = tile.call;
  const int width = step.width, input = step.number, begin = tile.begin();
  const auto to = tile.target(step);
  const int row = Tile::worker();
  if (width > kFewColumns && !call.transposed[input]) {  // neighbouring lanes read neighbouring columns
    return for_each_entry<Tile>(tile.rows(), width, [&](int row, int column) {
      to.put(row, column, input_row(call, input, width, source_row(call.rows, begin + row)).column(column));
    });
  }
  if (width > kFewColumns) {
    if (row >= tile.rows()) return;
    const InputRow from = input_row(call, input, width, source_row(call.rows, begin + row));
    for (int column = 0; column < width; ++column) to.put(row, column, from.column(column));
    return;
  }
  float values[kFewColumns] = {};
  if (row < tile.rows()) {
    load_few(values, input_row(call, input, width, source_row(call.rows, begin + row)), width);
    float* const floats = to.floats + row * to.stride;
    if (to.has_floats) for_few(width, [&](int i) { floats[i] = values[i]; });
  }
  if (!to.has_halves || row >= Tile::kRows) return;
  // Stores the whole padded row; rows without a sample are 0.
  static_assert(kFewColumns == 8, "one store of 16 bytes");
  auto* const words = reinterpret_cast<uint4*>(to.halves + row * to.halves_stride);
  const auto word = [&](int i) { return pack_halves<Tile::kBfloat16>(values[i], values[i + 1]); };
  words[0] = uint4{word(0), word(2), word(4), word(6)};
#pragma unroll
  for (int i = 1; i < pair_words(kFewColumns) / 4; ++i) words[i] = uint4{0, 0, 0, 0};
}

template <typename Tile>
__device__ __forceinline__ void output_step(const Tile& tile, const CudaStep& step) {
  const CudaProgram& call = tile.call;
  const int output = step.number, width = step.width, type = call.output_types[output], begin = tile.begin();
  const int64_t wide = call.output_widths[output];
  void* const to = call.outputs[output];
  if (width > kFewColumns || step.added >= 0) {
    const Operand x = step.added < 0 ? Operand{tile.slot(step.x.slot) + step.x.start, step.x.stride, false}
                                     : tile.operand(call.code.operands[step.added]);
    return with_type(type, [&](auto type) {
      for_each_entry<Tile>(tile.rows(), width, [&](int row, int column) {
        const int64_t source = source_row(call.rows, begin + row);
        store_number<decltype(type)::value>(to, source * wide + step.depth + column, x.at(row, column));
      });
    });
  }
  const int row = Tile::worker();
  if (row >= tile.rows()) return;
  const int64_t first = source_row(call.rows, begin + row) * wide + step.depth;
  const float* const x = tile.slot(step.x.slot) + step.x.start + row * step.x.stride;
  float values[kFewColumns] = {};
  for_few(width, [&](int i) { values[i] = x[i]; });
  with_type(type, [&](auto type) {
    constexpr TableType kType = decltype(type)::value;
    auto* const at = static_cast<InMemory<kType>*>(to) + first;
    for_few(width, [&](int i) { store_number<kType>(at, i, values[i]); });
  });
}

}  // namespace voronerf
