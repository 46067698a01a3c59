// Runs programs on threads, task by task (row_tasks.h).
#include "network/program.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <string>

#include "common/common.h"
#include "common/flush_denormals.h"
#include "common/parallel.h"
#include "network/cpu/program_rows.h"
#include "network/cpu/row_tasks.h"

namespace voronerf {

namespace {

constexpr RowLimits kRows{96, 1024}, kSumRows{384, 4096};
constexpr int64_t kTaskUnit = 48, kTileUnit = 96;  // tasks are multiples of a tile or half a tile
constexpr int64_t kSlack = 128;                    // floats after the slots that vectors may read and write

int64_t aligned(int64_t floats) { return ceil_div<int64_t>(floats, kGranule) * kGranule; }

#if VN_HAS_TILES
#define VN_FOR_TILES(isa, call)             \
  if (isa == Isa::amx) return avx512::call; \
  return portable::call;
#else
#define VN_FOR_TILES(isa, call) return portable::call;
#endif

bool in_tiles(const ProgramTable& table) {
  return table.layout == ProgramLayout::tiles || table.layout == ProgramLayout::parts;
}

// Returns whether a value is outside [0, end): for such a value, the value itself or end - 1 minus the value is
// negative. The loop collects sign bits, which compilers vectorise on any processor, unlike unsigned comparisons.
bool out_of_range(const int32_t* values, int64_t n, int64_t end) {
  const auto last = static_cast<uint32_t>(end - 1);
  uint32_t signs = 0;
  for (int64_t i = 0; i < n; ++i) signs |= static_cast<uint32_t>(values[i]) | (last - static_cast<uint32_t>(values[i]));
  return signs >> 31 != 0;
}

void check(const ProgramInputs& in) {
  const std::string op = in.caller;
  check_offsets(op, in.offsets, in.k, in.n);
  const bool unchecked = op == "grouped_program";  // other operations compute the order themselves
  if (unchecked && in.order != nullptr && out_of_range(in.order, in.n, in.n)) {
    const auto [low, high] = std::minmax_element(in.order, in.order + in.n);
    throw std::invalid_argument(op + ": order must lie in 0 to " + std::to_string(in.n - 1) + ", got values from " +
                                std::to_string(*low) + " to " + std::to_string(*high));
  }
  if (in.ray_index != nullptr && out_of_range(in.ray_index, in.n, in.r)) {
    const auto [low, high] = std::minmax_element(in.ray_index, in.ray_index + in.n);
    throw std::invalid_argument(op + ": " + in.ray_name + " must be 0 to " + std::to_string(in.r - 1) + ", got " +
                                std::to_string(*low < 0 ? *low : *high));
  }
}

constexpr int64_t kMostFetched = 1 << 15;  // floats per cell

// Prefetches memory of the next cell: with many small cells, each would wait for its memory. Large cells run so long
// that the wait does not matter, and prefetching them would evict data in use.
void fetch(const float* from, int64_t floats, bool writes) {
  constexpr int64_t kLine = 16;  // floats
  asm volatile("");              // otherwise GCC removes calls of a function that only prefetches
  for (int64_t i = 0; i < floats; i += kLine) {
    if (writes) {
      __builtin_prefetch(from + i, 1, 2);
    } else {
      __builtin_prefetch(from + i, 0, 2);
    }
  }
}

// Prefetches each parameter of a cell once.
void fetch_parameters(const CpuProgram& call, int64_t cell) {
  if (call.code.packed > kMostFetched) return;
  uint64_t seen = 0;  // prefetched parameters: most are packed twice
  for (int32_t p = 0; p < call.code.pack_count; ++p) {
    const ProgramPack& pack = call.code.packs[p];
    const uint64_t bit = uint64_t{1} << (pack.parameter & 63);
    if (pack.kind == ProgramPackKind::waves || (seen & bit) != 0) continue;
    seen |= bit;
    const int64_t stride = call.strides[pack.parameter];
    fetch(static_cast<const float*>(call.parameters[pack.parameter]) + cell * stride, stride, false);
  }
}

// Prefetches the sums of a cell, which will be written next.
void fetch_sums(const CpuProgram& call, int64_t cell) {
  if (call.code.partial > kMostFetched) return;
  for (int32_t s = 0; s < call.code.sum_count; ++s) {
    const ProgramSum& sum = call.code.sums[s];
    if (sum.size > kMostFetched) continue;  // the sum of a table
    if (s == 0 || call.code.sums[s - 1].sum != sum.sum) fetch(call.sums[sum.sum] + cell * sum.size, sum.size, true);
  }
}

// Sets outputs of rows in no cell to 0.
void clear_strays(const ProgramInputs& in, const ProgramResults& results, const ProgramTable& table) {
  for (size_t o = 0; o < table.outputs.size(); ++o) {
    if (table.outputs[o].ray || in.n == 0) continue;
    const bool half = results.output_types[o] == TableType::bfloat16;
    const int64_t bytes = table.outputs[o].width * (half ? 2 : 4);
    char* const out = static_cast<char*>(results.outputs[o]);
    const auto clear = [&](int64_t begin, int64_t end) {
      if (in.order == nullptr) {
        std::memset(out + begin * bytes, 0, static_cast<size_t>((end - begin) * bytes));
      } else {
        for (int64_t i = begin; i < end; ++i) std::memset(out + in.order[i] * bytes, 0, static_cast<size_t>(bytes));
      }
    };
    clear(0, in.offsets[0]);
    clear(in.offsets[in.k], in.n);
  }
}

// Zeros the part of the caller's memory for a look-up's result, `kept` [n][stride], that the look-up does not write:
// rows in no cell, and columns after the features.
void clear_kept(const ProgramInputs& in, int64_t features, int64_t stride, float* kept, int threads) {
  std::fill(kept, kept + in.offsets[0] * stride, 0.0f);
  std::fill(kept + in.offsets[in.k] * stride, kept + in.n * stride, 0.0f);
  constexpr int64_t kRun = 1024;
  parallel_for(features < stride ? in.n.value : 0, kRun, threads,
               [&](int64_t row) { std::fill(kept + row * stride + features, kept + (row + 1) * stride, 0.0f); });
}

// The rows with a non-zero gradient: only they add to sums. For example, samples that no light reaches have gradient 0.
// rows: their indices in the order of the cells. order: their indices in the caller's order. offsets: [k+1], the start
// of each cell in `rows`; empty if no list is made, because all rows are used.
struct Sifted {
  std::vector<int32_t> rows, order, offsets;
};

// Returns whether all values, float32 or bfloat16 (half), are 0 or -0.
bool all_zero(const char* values, int64_t count, bool half) {
  const int64_t bytes = count * (half ? 2 : 4);
  const uint64_t sizes = half ? 0x7fff7fff7fff7fffu : 0x7fffffff7fffffffu;
  uint64_t any = 0;
  for (int64_t i = 0; i < bytes; i += 8) {
    uint64_t some = 0;
    if (i + 8 <= bytes) {
      std::memcpy(&some, values + i, 8);
    } else {
      std::memcpy(&some, values + i, static_cast<size_t>(bytes - i));
    }
    any |= some & sizes;
  }
  return any == 0;
}

// Lists the rows with a non-zero gradient: blocks of rows make lists, which are then concatenated. All parts of
// the result, also `offsets`, are empty if so few rows have zero gradient that compacting does not pay.
Sifted sift(const ProgramTable& table, const ProgramInputs& in, int threads) {
  constexpr int64_t kBlock = 1024;
  const int64_t first = in.offsets[0], row_count = in.offsets[in.k] - first, blocks = ceil_div(row_count, kBlock);
  std::vector<int32_t> lists(row_count), begins(blocks + 1, 0);
  parallel_for(blocks, 1, threads, [&](int64_t block) {
    int32_t* to = lists.data() + block * kBlock;
    int32_t count = 0;
    const int64_t begin = first + block * kBlock, end = std::min(first + row_count, begin + kBlock);
    bool zero[kBlock];
    std::fill_n(zero, kBlock, true);
    for (size_t input = static_cast<size_t>(in.gradients); input < table.inputs.size(); ++input) {
      const int64_t width = table.inputs[input].width;
      const bool half = in.input_types[input] == TableType::bfloat16, transposed = in.transposed[input] != 0;
      const auto* from = static_cast<const char*>(in.inputs[input]);
      const int32_t* order = in.order;
      for (int64_t i = begin; i < end; ++i) {
        const int64_t row = order == nullptr ? i : order[i];
        if (transposed) {
          for (int64_t c = 0; c < width; ++c) zero[i - begin] &= all_zero(from + 4 * (c * in.n + row), 1, false);
        } else {
          zero[i - begin] &= all_zero(from + row * width * (half ? 2 : 4), width, half);
        }
      }
    }
    for (int64_t i = begin; i < end; ++i) {
      to[count] = static_cast<int32_t>(i);
      count += !zero[i - begin];
    }
    begins[block + 1] = count;
  });
  for (int64_t block = 0; block < blocks; ++block) begins[block + 1] += begins[block];
  const int64_t count = blocks > 0 ? begins[blocks] : 0;
  Sifted result;
  constexpr int64_t kPart = 16;  // compact only if at least 1/kPart of the rows is left out
  if (count > row_count - row_count / kPart) return result;
  result.rows.resize(count);
  result.order.resize(count);
  parallel_for(blocks, 1, threads, [&](int64_t block) {
    const int32_t* from = lists.data() + block * kBlock;
    for (int32_t i = begins[block]; i < begins[block + 1]; ++i) {
      const int32_t row = *from++;
      result.rows[i] = row;
      result.order[i] = in.order == nullptr ? row : in.order[row];
    }
  });
  result.offsets.resize(in.k + 1);
  for (int64_t cell = 0; cell <= in.k; ++cell) {
    result.offsets[cell] = static_cast<int32_t>(
        std::lower_bound(result.rows.begin(), result.rows.end(), in.offsets[cell]) - result.rows.begin());
  }
  return result;
}

// Sums rows [n, width] over the samples of each ray, in the order of the cells.
void sum_by_ray(const ProgramInputs& in, int64_t width, const float* rows, float* out) {
  std::fill(out, out + in.r * width, 0.0f);
  for (int64_t i = in.offsets[0]; i < in.offsets[in.k]; ++i) {
    float* to = out + in.ray_index[in.order == nullptr ? i : in.order[i]] * width;
    for (int64_t c = 0; c < width; ++c) to[c] += rows[i * width + c];
  }
}

// Looks up rows [begin, end) in a grid, one level after the other, so that the entries of a level stay in cache.
void lookup_by_level(const HashEncoding& grid, int64_t begin, int64_t end, float* out, int64_t stride, Isa isa,
                     int threads) {
  constexpr int64_t kLine = 64, kTask = 1 << 14;  // bytes, rows
  const int64_t runs = ceil_div(end - begin, kTask);
  parallel_for(grid.count * runs, 1, threads, [&](int64_t item) {
    const int64_t level = item / runs, first = begin + item % runs * kTask, last = std::min(end, first + kTask);
    const int64_t entry = grid.features * (grid.in.type == TableType::float32 ? 4 : 2);
    const char* table = static_cast<const char*>(grid.in.table) + grid.levels[level].offset * entry;
    const int64_t size = grid.levels[level].entries * entry;
    for (int64_t byte = 0; 8 * kLine * (last - first) > size && byte < size; byte += kLine) {
      __builtin_prefetch(table + byte, 0, 2);
    }
    hash_level_cpu(grid, level, out, stride, first, last, isa);
  });
}

ProgramCode code_of(const ProgramTable& table) {
  const auto count = [](const auto& records) { return static_cast<int32_t>(records.size()); };
  ProgramCode code{};
  code.packs = table.packs.data();
  code.steps = table.steps.data();
  code.operands = table.operands.data();
  code.sums = table.sums.data();
  code.pack_count = count(table.packs);
  code.step_count = count(table.steps);
  code.sum_count = count(table.sums);
  code.tile = table.tile;
  code.columns = table.columns;
  code.packed = table.packed;
  code.partial = table.partial;
  code.scratch = table.scratch;
  code.scratch_width = table.scratch_width;
  return code;
}

}  // namespace

ProgramRows::ProgramRows(const Program& program, const ProgramInputs& in, Isa isa)
    : table_(program.table),
      isa_(isa),
      tile_(in_tiles(table_) ? table_.tile : std::min<int64_t>(table_.tile, tile_rows())),
      rays_(new bool[table_.inputs.size()]),
      transposed_(new bool[table_.inputs.size()]) {
  for (size_t i = 0; i < table_.inputs.size(); ++i) {
    input_widths_.push_back(table_.inputs[i].width);
    rays_[i] = table_.inputs[i].ray;
    transposed_[i] = in.transposed[i] != 0;
  }
  for (const ProgramOutput& output : table_.outputs) output_widths_.push_back(output.width);
  for (const HashGrid& grid : table_.grids) {
    HashInputs none{};
    for (const GridLevel& level : grid.levels) none.entries += level.entries;
    grids_.push_back(hash_encoding(none, grid));
  }
}

int64_t ProgramRows::workspace() const { return aligned(aligned(table_.packed) + table_.columns * tile_ + kSlack); }

CpuProgram ProgramRows::call(const ProgramInputs& in, const ProgramResults& results, bool* in_place) const {
  for (size_t i = 0; i < table_.inputs.size(); ++i) {
    const bool plain = in.input_types[i] == TableType::float32 && !transposed_[i] && !rays_[i];
    in_place[i] = plain && in.order == nullptr;
  }
  CpuProgram call{};
  call.code = code_of(table_);
  call.inputs = in.inputs;
  call.input_types = in.input_types.data();
  call.input_widths = input_widths_.data();
  call.transposed = transposed_.get();
  call.rays = rays_.get();
  call.in_place = in_place;
  call.parameters = in.parameters;
  call.parameter_types = in.parameter_types.data();
  call.strides = in.strides.data();
  call.outputs = results.outputs;
  call.output_types = results.output_types.data();
  call.output_widths = output_widths_.data();
  call.sums = results.sums;
  call.grids = grids_.data();
  call.order = in.order;
  call.ray_index = in.ray_index;
  call.n = in.n;
  call.tile = tile_;
  call.parts = table_.layout == ProgramLayout::parts;
  return call;
}

void ProgramRows::pack(const CpuProgram& call, int64_t cell, bool first, float* own) const {
  float* const tiles = own + aligned(table_.packed);
  if (in_tiles(table_)) {
    VN_FOR_TILES(isa_, program_tiles_pack(call, cell, first, own, tiles))
  }
#if VN_HAS_HALF
  if (table_.layout == ProgramLayout::pairs) return avx512::program_half_pack(call, cell, first, own, tiles);
#endif
  VN_FOR_ISA(isa_, program_pack(call, cell, first, own, tiles))
}

void ProgramRows::run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, float* own,
                      float* partial) const {
  float* const tiles = own + aligned(table_.packed);
  if (in_tiles(table_)) {
    VN_FOR_TILES(isa_, program_tiles_run(call, cell, begin, end, own, tiles, partial))
  }
#if VN_HAS_HALF
  if (table_.layout == ProgramLayout::pairs) {
    return avx512::program_half_run(call, cell, begin, end, own, tiles, partial);
  }
#endif
  VN_FOR_ISA(isa_, program_run(call, cell, begin, end, own, tiles, partial))
}

void ProgramRows::reduce(const CpuProgram& call, int64_t cell, float* partials, int64_t count) const {
  VN_FOR_ISA(isa_, program_reduce(call, cell, partials, count))
}

void ProgramRows::forward(const ProgramInputs& in, const ProgramResults& results, WorkerMemory& own) const {
  constexpr size_t kFew = 16;  // limit for inputs and for memories; more would need an allocation per call
  VN_CHECK(table_.inputs.size() <= kFew && table_.memories.size() <= kFew, "a program of rows has at most 16 inputs");
  bool in_place[kFew];
  float* memories[kFew] = {};
  bool filled[kFew] = {};
  CpuProgram program_call = call(in, results, in_place);
  program_call.memories = memories;
  program_call.filled = filled;
  for (int64_t cell = 0; cell < in.k; ++cell) {
    if (in.offsets[cell] == in.offsets[cell + 1]) continue;
    if (cell != own.packed) pack(program_call, cell, own.packed < 0, own.memory);
    own.packed = cell;
    run(program_call, cell, in.offsets[cell], in.offsets[cell + 1], own.memory, nullptr);
  }
}

void grouped_program_cpu(const Program& program, const ProgramInputs& original, const ProgramResults& results, Isa isa,
                         int threads) {
  const ProgramTable& table = program.table;
  check(original);
  ProgramInputs in = original;
  Sifted sifted;
  if (original.gradients >= 0) sifted = sift(table, original, threads);
  const bool compacted = !sifted.offsets.empty();
  if (compacted) {
    in.n = static_cast<int64_t>(sifted.rows.size());
    in.order = sifted.order.data();
    in.offsets = sifted.offsets.data();
  }
  const ProgramRows rows(program, in, isa);
  std::unique_ptr<bool[]> in_place(new bool[table.inputs.size()]), filled(new bool[table.memories.size()]());
  std::vector<float*> memories(table.memories.size(), nullptr);
  CpuProgram call = rows.call(in, results, in_place.get());
  call.memories = memories.data();
  call.filled = filled.get();
  call.n = original.n;
  clear_strays(in, results, table);

  // The workspace of the call: the working memory of each thread, partial sums, arrays of n rows (see `memories`), and
  // points in the order of the cells.
  const bool summed = !table.sums.empty();
  const int64_t unit = in_tiles(table) ? kTileUnit : kTaskUnit;
  const RowTasks tasks = split_rows(in.offsets, in.k, in.n, summed ? kSumRows : kRows, unit, table.partial);
  const int64_t own_partial = rows.workspace(), stride = aligned(own_partial + table.partial);
  const int64_t partials = summed ? tasks.first_partial[in.k] : 0;
  int64_t floats = stride * threads + aligned(partials * table.partial);
  const auto take = [&floats](int64_t count) {
    const int64_t at = floats;
    floats += aligned(count);
    return at;
  };
  std::vector<int64_t> places(table.memories.size(), -1), points(table.inputs.size(), -1);
  const auto gather = [&](int32_t input) {
    auto& place = points[static_cast<size_t>(input)];
    if (in.order != nullptr && place < 0) place = take(in.n * 3);
  };
  for (size_t l = 0; l < table.lookups.size(); ++l) {
    const ProgramLookup& lookup = table.lookups[l];
    float* const kept = in.kept == nullptr ? nullptr : in.kept[l];
    const auto m = static_cast<size_t>(lookup.memory);
    if (kept == nullptr) continue;
    if (compacted) {
      VN_CHECK(in.ready, "what is kept of rows with a gradient is ready");
      places[m] = take(in.n * table.memories[m]);
    } else {
      memories[m] = kept;
      const HashEncoding& grid = rows.grids()[static_cast<size_t>(lookup.grid)];
      if (!in.ready) clear_kept(in, grid.count * grid.features, table.memories[m], kept, threads);
    }
    const bool shared = in.strides[static_cast<size_t>(lookup.parameter)] == 0 || in.k == 1;
    filled[m] = in.ready || shared;
    if (!in.ready && shared) gather(lookup.input);
  }
  const auto is_filled = [&](const ProgramLookup& lookup) { return filled[static_cast<size_t>(lookup.memory)]; };
  call.looked_up = std::all_of(table.lookups.begin(), table.lookups.end(), is_filled);
  for (const ProgramScatter& scatter : table.scatters) {
    places[static_cast<size_t>(scatter.memory)] = take(in.n * table.memories[static_cast<size_t>(scatter.memory)]);
    gather(scatter.input);
  }
  for (const ProgramOutput& output : table.outputs) {
    if (output.ray) places[static_cast<size_t>(output.memory)] = take(in.n * output.width);
  }
  for (size_t o = 0; o < table.outputs.size(); ++o) {
    const ProgramOutput& output = table.outputs[o];
    const bool in_place_output = !output.ray && in.order == nullptr && results.output_types[o] == TableType::float32;
    if (in_place_output && output.memory >= 0) {
      memories[static_cast<size_t>(output.memory)] = static_cast<float*>(results.outputs[o]);
    }
  }
  const Workspace workspace(floats + kSlack);
  float* const memory = workspace.data();
  for (size_t m = 0; m < memories.size(); ++m) {
    if (places[m] >= 0) memories[m] = memory + places[m];
  }
  constexpr int64_t kRun = 512;  // rows per run of a copy
  if (compacted) {
    for (size_t l = 0; l < table.lookups.size(); ++l) {
      const auto m = static_cast<size_t>(table.lookups[l].memory);
      const float* const kept = in.kept == nullptr ? nullptr : in.kept[l];
      if (kept == nullptr) continue;
      const int64_t width = table.memories[m];
      parallel_for(in.n, kRun, threads, [&](int64_t row) {
        std::copy_n(kept + sifted.rows[static_cast<size_t>(row)] * width, width, memories[m] + row * width);
      });
    }
  }
  const auto points_of = [&](int32_t input) {
    const int64_t place = points[static_cast<size_t>(input)];
    return place < 0 ? static_cast<const float*>(in.inputs[input]) : memory + place;
  };
  for (size_t i = 0; i < points.size(); ++i) {
    if (points[i] < 0) continue;
    const float* const from = static_cast<const float*>(in.inputs[i]);
    float* const to = memory + points[i];
    parallel_for(in.n, kRun, threads, [&](int64_t row) { std::copy_n(from + 3 * in.order[row], 3, to + 3 * row); });
  }
  const auto grid_of = [&](int32_t number, int32_t parameter, int32_t input) {
    HashEncoding grid = rows.grids()[static_cast<size_t>(number)];
    grid.in.table = in.parameters[parameter];
    grid.in.type = in.parameter_types[static_cast<size_t>(parameter)];
    grid.in.tables = 1;
    grid.in.positions = points_of(input);
    return grid;
  };

  // Look up points in tables that all cells share, level by level, so that the entries of a level stay in cache.
  for (const ProgramLookup& lookup : table.lookups) {
    const auto m = static_cast<size_t>(lookup.memory);
    if (in.ready || memories[m] == nullptr || !filled[m]) continue;
    const HashEncoding grid = grid_of(lookup.grid, lookup.parameter, lookup.input);
    lookup_by_level(grid, in.offsets[0], in.offsets[in.k], memories[m], table.memories[m], isa, threads);
  }

  if (!tasks.tasks.empty()) {
    float* const partial = memory + stride * threads;
    for_each_task(
        tasks, memory, stride, threads,
        [&](int64_t cell, float* own, bool first) { rows.pack(call, cell, first, own); },
        [&](int64_t cell) { fetch_parameters(call, cell); },
        [&](const RowTask& task, float* own) {
          const bool alone = task.partial < 0;
          float* const to = alone ? own + own_partial : partial + task.partial * table.partial;
          if (alone && summed) fetch_sums(call, task.cell);
          rows.run(call, task.cell, task.begin, task.end, own, to);
          if (alone && summed) rows.reduce(call, task.cell, to, 1);
        });
  }
  if (summed) {
    float* const partial = memory + stride * threads;
    parallel_for(in.k, 1, threads, [&](int64_t cell) {
      const FlushDenormals flush;
      const int64_t count = tasks.partials(cell);
      const bool empty = in.offsets[cell + 1] == in.offsets[cell];
      if (count > 0 || empty) rows.reduce(call, cell, partial + tasks.first_partial[cell] * table.partial, count);
    });
  }

  // The gradients of tables, one item per table and level. Each item adds the rows in order, whatever the number of
  // threads.
  for (const ProgramScatter& scatter : table.scatters) {
    const auto m = static_cast<size_t>(scatter.memory);
    const HashEncoding grid = grid_of(scatter.grid, scatter.parameter, scatter.input);
    const bool shared = in.strides[static_cast<size_t>(scatter.parameter)] == 0;
    const int64_t tables = shared ? 1 : in.k, size = grid.in.entries * grid.features;
    float* const to = results.sums[scatter.sum];
    parallel_for(tables * grid.count, 1, threads, [&](int64_t item) {
      const int64_t table_index = item / grid.count, level = item % grid.count;
      hash_level_backward_cpu(grid, level, memories[m], table.memories[m], in.offsets[shared ? 0 : table_index],
                              in.offsets[shared ? in.k : table_index + 1], to + table_index * size, isa);
    });
  }
  for (size_t o = 0; o < table.outputs.size(); ++o) {
    const ProgramOutput& output = table.outputs[o];
    if (!output.ray) continue;
    sum_by_ray(in, output.width, memories[static_cast<size_t>(output.memory)], static_cast<float*>(results.outputs[o]));
  }
}

}  // namespace voronerf
