// grouped_mlp over threads, task by task (row_tasks.h).
#include "network/grouped_mlp.h"

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/common.h"
#include "common/parallel.h"
#include "network/cpu/grouped_mlp_isa.h"
#include "network/cpu/grouped_mlp_planner.h"
#include "network/cpu/grouped_mlp_rows.h"
#include "network/cpu/row_tasks.h"

namespace voronerf {

namespace {

constexpr RowLimits kRows{96, 1024}, kGradientRows{384, 4096};
// Tasks are whole tiles or halves of one.
constexpr int64_t kTaskUnit = 48;

void check(const MlpTable& table, const MlpInputs& in) {
  constexpr const char* kNames[] = {"grouped_mlp", "grouped_linear", "routed_mlp"};
  const std::string op = kNames[static_cast<int>(table.caller)];
  check_offsets(op, in.offsets, in.k, in.n);
  if (in.direction_index == nullptr) return;
  int32_t low = 0, high = -1;
  for (int64_t i = 0; i < in.n; ++i) {
    low = std::min(low, in.direction_index[i]);
    high = std::max(high, in.direction_index[i]);
  }
  if (low < 0 || high >= in.r) {
    throw std::invalid_argument(op + ": direction_index must be 0 to " + std::to_string(in.r - 1) + ", got " +
                                std::to_string(low < 0 ? low : high));
  }
}

// Rows of no cell.
void zero_strays(const MlpInputs& in, int64_t width, float* out) {
  const auto clear = [&](int64_t begin, int64_t end) {
    if (in.order == nullptr) {
      std::fill(out + begin * width, out + end * width, 0.0f);
    } else {
      for (int64_t i = begin; i < end; ++i) std::fill_n(out + in.order[i] * width, width, 0.0f);
    }
  };
  clear(0, in.offsets[0]);
  clear(in.offsets[in.k], in.n);
}

bool use_half(const MlpTable& table, Isa isa) { return table.half && isa == Isa::avx512_bf16; }

void prepare(Isa isa, const MlpPlan& plan, float* own) { VN_FOR_ISA(isa, mlp_prepare(plan, own)) }
void pack(Isa isa, const MlpPlan& plan, const MlpData& data, int64_t cell, float* own) {
#if VN_HAS_HALF
  if (plan.half) return avx512::mlp_half_pack(plan, data, cell, own);
#endif
  VN_FOR_ISA(isa, mlp_pack(plan, data, cell, own))
}
void run_rows(Isa isa, const MlpPlan& plan, const MlpData& data, const RowTask& task, float* own) {
#if VN_HAS_HALF
  if (plan.half) return avx512::mlp_half_forward(plan, data, task.cell, task.begin, task.end, own);
#endif
  VN_FOR_ISA(isa, mlp_forward(plan, data, task.cell, task.begin, task.end, own))
}
void backward(Isa isa, const MlpPlan& plan, const MlpData& data, const RowTask& task, float* own, float* partial) {
#if VN_HAS_HALF
  if (plan.half) return avx512::mlp_half_backward(plan, data, task.cell, task.begin, task.end, own, partial);
#endif
  VN_FOR_ISA(isa, mlp_backward(plan, data, task.cell, task.begin, task.end, own, partial))
}
void reduce(Isa isa, const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t layer, float* partials,
            int64_t count) {
  VN_FOR_ISA(isa, mlp_reduce(plan, data, cell, layer, partials, count))
}

// Weights of a cell on their way to the cache: of many small cells, each would be waited for. Large ones take so long
// to run that reading them does not show, and would push out what is in use.
void fetch(const MlpPlan& plan, const MlpData& data, int64_t cell) {
  constexpr int64_t kLine = 16, kMostFetched = 1 << 15;  // floats
  int64_t total = 0;
  for (int64_t l = 0; l < plan.layer_count; ++l) total += plan.layers[l].width * plan.layers[l].depth;
  if (total > kMostFetched) return;
  for (int64_t l = 0; l < plan.layer_count; ++l) {
    const int64_t size = plan.layers[l].width * plan.layers[l].depth;
    const float* weights = data.weights[l] + cell * size;
    for (int64_t i = 0; i < size; i += kLine) __builtin_prefetch(weights + i, 0, 2);
  }
}

// Floats of a thread's workspace.
int64_t stride(const MlpPlan& plan) { return ceil_div(plan.workspace, kGranule) * kGranule; }

template <typename Run>
void run_tasks(const RowTasks& tasks, const MlpPlan& plan, const MlpData& data, float* memory, Isa isa, int threads,
               const Run& run) {
  const auto pack_cell = [&](int64_t cell, float* own, bool first) {
    if (first) prepare(isa, plan, own);
    pack(isa, plan, data, cell, own);
  };
  const auto ahead = [&](int64_t cell) { fetch(plan, data, cell); };
  for_each_task(tasks, memory, stride(plan), threads, pack_cell, ahead, run);
}

MlpData pointers(const MlpInputs& in) {
  MlpData data;
  data.positions = in.positions;
  data.directions = in.directions;
  data.direction_index = in.direction_index;
  data.order = in.order;
  data.weights = in.weights;
  data.biases = in.biases;
  data.hashed = in.encoded;
  return data;
}

MlpGathered gathered(const MlpInputs& in) {
  return {in.order != nullptr, in.order != nullptr || in.direction_index != nullptr};
}

// Without levels where positions are not hashed.
HashEncoding hash_of(const MlpTable& table, const MlpInputs& in) {
  if (table.position.kind != MlpEncodingKind::hash) return {};
  HashInputs given{};
  given.table = in.features;
  given.type = in.features_type;
  given.tables = in.tables;
  for (const GridLevel& level : table.grid.levels) given.entries += level.entries;
  return hash_encoding(given, table.grid);
}

// Rows that have a gradient. Those without, such as samples that no light reaches, add nothing to the gradients of
// parameters and tables.
struct Taught {
  std::vector<int32_t> rows, order, offsets;  // numbers as sorted, and of the caller; [k+1]. Empty: all rows
};

// Empty too where the few without a gradient would not pay for copies. Blocks of rows list their own, which are then
// put together.
Taught taught_rows(const MlpTable& table, const MlpInputs& in, const float* gradient, int threads) {
  constexpr int64_t kBlock = 1024;
  int64_t width = 0;
  for (const int output : table.outputs) width += table.layers[output].width;
  const int64_t first = in.offsets[0], all = in.offsets[in.k] - first, blocks = ceil_div(all, kBlock);
  std::vector<int32_t> lists(all), begins(blocks + 1, 0);
  parallel_for(blocks, 1, threads, [&](int64_t block) {
    int32_t* to = lists.data() + block * kBlock;
    int32_t count = 0;
    const int64_t begin = first + block * kBlock, end = std::min(first + all, begin + kBlock);
    for (int64_t i = begin; i < end; ++i) {
      const float* row = gradient + (in.order == nullptr ? i : in.order[i]) * width;
      bool zero = true;
      for (int64_t o = 0; o < width; ++o) zero &= row[o] == 0.0f;
      to[count] = static_cast<int32_t>(i);
      count += zero ? 0 : 1;
    }
    begins[block + 1] = count;
  });
  for (int64_t block = 0; block < blocks; ++block) begins[block + 1] += begins[block];
  const int64_t kept = begins[blocks];
  if (8 * kept > 7 * all) return {};
  Taught found;
  found.rows.resize(kept);
  found.order.resize(kept);
  parallel_for(blocks, 1, threads, [&](int64_t block) {
    const int32_t* from = lists.data() + block * kBlock;
    for (int64_t i = begins[block]; i < begins[block + 1]; ++i) {
      const int32_t row = *from++;
      found.rows[i] = row;
      found.order[i] = in.order == nullptr ? row : in.order[row];
    }
  });
  for (int64_t c = 0; c <= in.k; ++c) {
    const auto place = std::lower_bound(found.rows.begin(), found.rows.end(), in.offsets[c]);
    found.offsets.push_back(static_cast<int32_t>(place - found.rows.begin()));
  }
  return found;
}

// Hashed positions of all rows before the tiles, level by level. A step of training has written the whole table since
// it was read last. Many rows read most of a level: it is fetched in order, which takes a fraction of what waiting for
// each entry does, and stays in cache until its rows are done.
void encode_by_level(const MlpInputs& in, const MlpPlan& plan, const HashEncoding& all, float* positions, Isa isa,
                     int threads) {
  constexpr int64_t kLine = 64, kRun = 1024, kRows = 1 << 14;  // rows of a task
  const int64_t first = in.offsets[0], end = in.offsets[in.k], runs = ceil_div(end - first, kRows);
  parallel_for(in.order == nullptr ? 0 : end - first, kRun, threads,
               [&](int64_t i) { std::copy_n(in.positions + 3 * in.order[first + i], 3, positions + 3 * (first + i)); });
  parallel_for(all.count * runs, 1, threads, [&](int64_t item) {
    const int64_t level = item / runs, begin = first + item % runs * kRows, stop = std::min(end, begin + kRows);
    const int64_t entry = all.features * (all.in.type == TableType::float32 ? 4 : 2);
    const char* table = static_cast<const char*>(all.in.table) + all.levels[level].offset * entry;
    const int64_t size = all.levels[level].entries * entry;
    for (int64_t byte = 0; 8 * kLine * (stop - begin) > size && byte < size; byte += kLine) {
      __builtin_prefetch(table + byte, 0, 2);
    }
    HashEncoding one = all;
    one.in.positions = in.order == nullptr ? in.positions : positions;
    hash_level_cpu(one, level, in.encoded, plan.positions.value.stride, begin, stop, isa);
  });
}

// Gradient of the hash grid's tables: the levels of each, one at a time, since one fits a cache where all of them do
// not, and since the rows are then added up in their sorted order by any number of threads.
void scatter_hashed(const MlpInputs& in, const MlpPlan& plan, const HashEncoding& all, const float* positions,
                    const float* gradient, float* of_tables, Isa isa, int threads) {
  parallel_for(in.tables * all.count, 1, threads, [&](int64_t item) {
    const int64_t table = item / all.count, level = item % all.count;
    const bool shared = in.tables == 1;
    HashEncoding one = all;
    one.in.positions = positions;
    one.in.tables = 1;
    hash_level_backward_cpu(one, level, gradient, plan.positions.gradient.stride, in.offsets[shared ? 0 : table],
                            in.offsets[shared ? in.k : table + 1], of_tables + table * all.in.entries * all.features,
                            isa);
  });
}

// Gradients of the samples' directions, rows as sorted, summed over each ray's samples in that order.
void sum_by_ray(const MlpInputs& in, int64_t q, const float* samples, float* out) {
  std::fill(out, out + in.r * q, 0.0f);
  for (int64_t i = in.offsets[0]; i < in.offsets[in.k]; ++i) {
    float* to = out + in.direction_index[in.order == nullptr ? i : in.order[i]] * q;
    for (int64_t f = 0; f < q; ++f) to[f] += samples[i * q + f];
  }
}

}  // namespace

void grouped_mlp_cpu(const MlpTable& table, const MlpInputs& in, float* out, Isa isa, int threads) {
  check(table, in);
  const MlpPlanner planner(table, gathered(in), {false, false, false, false, use_half(table, isa)});
  const MlpPlan& plan = planner.plan();
  zero_strays(in, plan.out_features, out);
  const RowTasks tasks = split_rows(in.offsets, in.k, in.n, kRows, kTaskUnit, 0);
  if (tasks.tasks.empty()) return;
  MlpData data = pointers(in);
  data.out = out;
  const HashEncoding hash = hash_of(table, in);
  if (hash.count > 0) data.hash = &hash;
  const bool shared = hash.count > 0 && in.tables == 1 && in.encoded != nullptr;
  const int64_t sorted = shared && in.order != nullptr ? in.n * table.positions : 0;
  const Workspace workspace(stride(plan) * threads + sorted);
  data.encoded = shared;
  if (shared) encode_by_level(in, plan, hash, workspace.data() + stride(plan) * threads, isa, threads);
  run_tasks(tasks, plan, data, workspace.data(), isa, threads,
            [&](const RowTask& task, float* own) { run_rows(isa, plan, data, task, own); });
}

MlpRows::MlpRows(const MlpTable& table, const MlpInputs& in, const MlpGathered& gathered, Isa isa)
    : planner_(table, gathered, {false, false, false, false, use_half(table, isa)}),
      hash_(hash_of(table, in)),
      isa_(isa) {}

int64_t MlpRows::workspace() const { return stride(planner_.plan()); }

void MlpRows::forward(const MlpInputs& in, float* out, Own& own) const {
  const MlpPlan& plan = planner_.plan();
  MlpData data = pointers(in);
  data.out = out;
  if (hash_.count > 0) data.hash = &hash_;
  if (own.packed < 0) prepare(isa_, plan, own.memory);
  for (int64_t cell = 0; cell < in.k; ++cell) {
    const RowTask task{cell, in.offsets[cell], in.offsets[cell + 1], -1};
    if (task.begin == task.end) continue;
    if (cell != own.packed) pack(isa_, plan, data, cell, own.memory);
    own.packed = cell;
    run_rows(isa_, plan, data, task, own.memory);
  }
}

void grouped_mlp_backward_cpu(const MlpTable& table, const MlpInputs& given, const MlpGradients& gradients, Isa isa,
                              int threads) {
  check(table, given);
  MlpInputs in = given;
  Taught taught;
  if (gradients.positions == nullptr && gradients.directions == nullptr) {
    taught = taught_rows(table, given, gradients.output, threads);
  }
  const bool sifted = !taught.offsets.empty();
  if (sifted) {
    in.n = static_cast<int64_t>(taught.rows.size());
    in.order = taught.order.data();
    in.offsets = taught.offsets.data();
  }
  const bool indexed = in.direction_index != nullptr;
  const MlpWanted wanted{gradients.weights != nullptr, gradients.positions != nullptr, gradients.directions != nullptr,
                         gradients.features != nullptr, use_half(table, isa)};
  const MlpPlanner planner(table, gathered(in), wanted);
  const MlpPlan& plan = planner.plan();
  const RowTasks tasks = split_rows(in.offsets, in.k, in.n, kGradientRows, kTaskUnit, plan.partial);
  const int64_t partials = wanted.parameters ? tasks.first_partial[in.k] : 0;
  // Gradients of the samples' directions, before they are summed over each ray's samples.
  const bool by_ray = wanted.directions && indexed && plan.directions.used;
  const int64_t samples = by_ray ? in.n * table.directions : 0;
  // Of rows as sorted: what the levels of a hash grid are given.
  const bool scattered = wanted.features && plan.positions.used;
  const int64_t hashed = scattered ? in.n * plan.positions.gradient.stride : 0;
  const int64_t sorted = scattered && in.order != nullptr ? in.n * table.positions : 0;
  const int64_t encoded = sifted && in.encoded != nullptr ? in.n * plan.positions.value.stride : 0;
  const Workspace workspace(stride(plan) * threads + partials * plan.partial + hashed + samples + sorted + encoded);
  float* memory = workspace.data();
  float* partial = memory + stride(plan) * threads;
  float* hashed_gradient = partial + partials * plan.partial;
  float* sample_directions = hashed_gradient + hashed;
  float* sorted_positions = sample_directions + samples;
  if (encoded > 0) {
    in.encoded = sorted_positions + sorted;
    constexpr int64_t kRun = 512;
    parallel_for(in.n, kRun, threads, [&](int64_t row) {
      const int64_t width = plan.positions.value.stride;
      std::copy_n(given.encoded + taught.rows[row] * width, width, in.encoded + row * width);
    });
  }

  MlpData data = pointers(in);
  data.grad_out = gradients.output;
  data.grad_weights = gradients.weights;
  data.grad_biases = gradients.biases;
  data.grad_positions = gradients.positions;
  data.grad_directions = indexed ? sample_directions : gradients.directions;
  const HashEncoding hash = hash_of(table, in);
  if (hash.count > 0) data.hash = &hash;
  VN_CHECK(hash.count == 0 || in.n == 0 || in.encoded != nullptr,
           "grouped_mlp: hashed positions must be given encoded");
  if (scattered) data.hashed_gradient = hashed_gradient;
  if (sorted > 0) data.sorted_positions = sorted_positions;
  const auto clear = [&](float* out, int64_t width, bool used) {
    if (used) {
      zero_strays(in, width, out);
    } else {
      std::fill(out, out + in.n * width, 0.0f);
    }
  };
  if (wanted.positions) clear(data.grad_positions, table.positions, plan.positions.used);
  if (wanted.directions && !indexed) clear(data.grad_directions, table.directions, plan.directions.used);

  if (!tasks.tasks.empty()) {
    run_tasks(tasks, plan, data, memory, isa, threads, [&](const RowTask& task, float* own) {
      float* to = task.partial < 0 ? own + plan.own_partial : partial + task.partial * plan.partial;
      backward(isa, plan, data, task, own, to);
      if (task.partial >= 0 || !wanted.parameters) return;
      for (int64_t l = 0; l < plan.layer_count; ++l) reduce(isa, plan, data, task.cell, l, to, 1);
    });
  }
  if (wanted.parameters) {
    parallel_for(in.k * plan.layer_count, 1, threads, [&](int64_t item) {
      const int64_t cell = item / plan.layer_count, l = item % plan.layer_count;
      const int64_t first = tasks.first_partial[cell], count = tasks.partials(cell);
      const bool empty = in.offsets[cell + 1] == in.offsets[cell];
      if (count > 0 || empty) reduce(isa, plan, data, cell, l, partial + first * plan.partial, count);
    });
  }
  if (scattered) {
    scatter_hashed(in, plan, hash, sorted > 0 ? sorted_positions : in.positions, hashed_gradient, gradients.features,
                   isa, threads);
  } else if (wanted.features) {
    std::fill_n(gradients.features, in.tables * hash.in.entries * hash.features, 0.0f);
  }
  if (by_ray) {
    sum_by_ray(in, table.directions, sample_directions, gradients.directions);
  } else if (wanted.directions && indexed) {
    std::fill(gradients.directions, gradients.directions + in.r * table.directions, 0.0f);
  }
}

}  // namespace voronerf
