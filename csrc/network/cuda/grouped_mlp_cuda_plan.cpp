#include "network/cuda/grouped_mlp_cuda_plan.h"

#include <algorithm>
#include <vector>

#include "common/common.h"
#include "network/grouped_mlp_layout.h"

namespace voronerf {

namespace {

constexpr int kWidest = 256;
// Tasks of a multiprocessor: many, since the last ones leave others idle; backward each has a partial gradient.
constexpr int kForwardTasks = 32;
constexpr int kBackwardTasks = 8;
// Warps of a multiprocessor that hide each other's waiting for shared memory and products; more of them do not pay for
// weights that pass through, or for fewer rows.
constexpr int kEnoughWarps = 8;
constexpr int kBlockReserve = 1024;  // bytes of shared memory that the system takes of each block

int pad(int64_t width) { return static_cast<int>(ceil_div<int64_t>(width, kMlpDepth) * kMlpDepth); }

bool is_half(MlpPrecision precision) {
  return precision == MlpPrecision::bfloat16 || precision == MlpPrecision::float16;
}

// Strides of values and weights: 16 bytes more than a multiple of 32, so that eight rows lie in different banks.
void place_weights(MlpCudaPlan& plan, int skew) {
  for (int l = 0; l < plan.layer_count; ++l) {
    MlpCudaLayer& layer = plan.layers[l];
    layer.partial_stride = layer.weight_stride;
    layer.weight_stride += skew;
    layer.weight = plan.packed_weights;
    layer.bias = plan.packed_biases;
    plan.packed_weights += layer.padded * layer.weight_stride;
    plan.packed_biases += layer.padded;
    layer.partial = plan.partial;
    layer.partial_bias = layer.partial + layer.padded * layer.partial_stride;
    plan.partial = layer.partial_bias + layer.padded;
  }
}

// The time of layer l is 2 l + 2: it reads then, and writes at once if it has more outputs than fit the registers, else
// after it has read all. Backward everything is kept.
int place_values(MlpCudaPlan& plan, int rows, int skew) {
  const int end = 2 * plan.layer_count + 4;
  std::vector<int> last(plan.layer_count, 0);
  int last_position = 0, last_direction = 0;
  for (int l = 0; l < plan.layer_count; ++l) {
    if (!plan.layers[l].live) continue;
    for (int s = 0; s < plan.layers[l].source_count; ++s) {
      const int from = plan.layers[l].sources[s].from;
      int& use = from >= 0 ? last[from] : from == kFromPositions ? last_position : last_direction;
      use = 2 * l + 2;
    }
  }
  Arena arena;
  const auto place_input = [&](MlpCudaInput& input, int until) {
    input.stride = input.padded + skew;
    if (input.used) input.value = static_cast<int>(arena.take(rows * input.stride, 0, plan.backward ? end : until));
  };
  place_input(plan.positions, last_position);
  place_input(plan.directions, last_direction);
  for (int l = 0; l < plan.layer_count; ++l) {
    MlpCudaLayer& layer = plan.layers[l];
    layer.stride = layer.padded + skew;
    layer.slope = -1;
    if (!layer.live) continue;
    const int start = 2 * l + 2 + (layer.padded <= kMlpChunk ? 1 : 0);
    layer.value =
        static_cast<int>(arena.take(rows * layer.stride, start, plan.backward ? end : std::max(last[l], start)));
    if (plan.backward && layer.activation == static_cast<int>(Activation::sine)) {
      layer.slope = static_cast<int>(arena.take(rows * layer.stride, 0, end));
    }
  }
  return static_cast<int>(arena.total());
}

// Elements of the largest piece of weights that passes through the slot.
int slot_of(const MlpCudaPlan& plan, int skew) {
  int size = 0;
  for (int l = 0; l < plan.layer_count; ++l) {
    const MlpCudaLayer& layer = plan.layers[l];
    if (!layer.live) continue;
    size = std::max(size, std::min(layer.padded, kMlpChunk) * layer.weight_stride);
    if (plan.backward) size = std::max(size, layer.padded * (kMlpChunk + skew));
  }
  return size;
}

}  // namespace

MlpCudaInput mlp_cuda_input(int64_t raw, const MlpEncoding& encoding) {
  MlpCudaInput input{};
  input.raw = static_cast<int>(raw);
  input.integrated = encoding.kind == MlpEncodingKind::integrated;
  input.hashed = encoding.kind == MlpEncodingKind::hash;
  input.octaves = encoding.kind == MlpEncodingKind::frequency || input.integrated ? encoding.size : -1;
  input.degree = encoding.kind == MlpEncodingKind::spherical ? encoding.size : 0;
  input.width = static_cast<int>(encoded_width(raw, encoding));
  input.padded = pad(input.width);
  return input;
}

const char* mlp_cuda_read_table(const MlpTable& table, MlpCudaPlan& plan) {
  if (table.layers.size() > kMlpCudaLayers) return "a table must have at most 16 layers";
  if (table.outputs.size() > kMlpCudaOutputs) return "a table must have at most 8 outputs";
  plan.positions = mlp_cuda_input(table.positions, table.position);
  plan.directions = mlp_cuda_input(table.directions, table.direction);
  plan.layer_count = static_cast<int>(table.layers.size());
  for (int l = 0; l < plan.layer_count; ++l) {
    const MlpLayer& given = table.layers[l];
    MlpCudaLayer& layer = plan.layers[l];
    layer = {};
    if (given.inputs.size() > kMlpCudaSources) return "a layer must have at most 4 sources";
    if (given.width > kWidest) return "a layer must have at most 256 features";
    layer.width = static_cast<int>(given.width);
    layer.padded = pad(given.width);
    layer.activation = static_cast<int>(given.activation);
    layer.source_count = static_cast<int>(given.inputs.size());
    int packed = 0;
    for (int s = 0; s < layer.source_count; ++s) {
      const int from = given.inputs[s];
      MlpCudaSource& source = layer.sources[s];
      source.from = from;
      source.width = from >= 0                ? plan.layers[from].width
                     : from == kFromPositions ? plan.positions.width
                                              : plan.directions.width;
      if (source.width < 1) return "a layer's sources must have features";
      if (source.width > kWidest) return "a source must have at most 256 features";
      source.padded = pad(source.width);
      source.column = layer.inputs;
      source.packed = packed;
      layer.inputs += source.width;
      packed += source.padded;
    }
    layer.weight_stride = packed;
  }
  plan.output_count = static_cast<int>(table.outputs.size());
  for (int o = 0; o < plan.output_count; ++o) {
    plan.outputs[o] = table.outputs[o];
    plan.output_columns[o] = plan.out_features;
    plan.out_features += plan.layers[table.outputs[o]].width;
    plan.layers[table.outputs[o]].live = true;
  }
  for (int l = plan.layer_count; l-- > 0;) {
    const MlpCudaLayer& layer = plan.layers[l];
    if (!layer.live) continue;
    for (int s = 0; s < layer.source_count; ++s) {
      const int from = layer.sources[s].from;
      if (from >= 0) plan.layers[from].live = true;
      if (from == kFromPositions) plan.positions.used = true;
      if (from == kFromDirections) plan.directions.used = true;
    }
  }
  return nullptr;
}

const char* mlp_cuda_plan(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k, bool backward,
                          const MlpCudaDevice& device, MlpCudaPlan& plan) {
  plan = {};
  // What tensor cores cannot multiply before 8.0 is multiplied exactly.
  if (device.capability < 80 && precision != MlpPrecision::float16) precision = MlpPrecision::float32;
  plan.precision = precision;
  plan.backward = backward;
  if (const char* fault = mlp_cuda_read_table(table, plan)) return fault;
  const int size = is_half(precision) ? 2 : 4, skew = 16 / size;
  place_weights(plan, skew);
  plan.packed_bytes = ceil_div<int64_t>(int64_t{plan.packed_weights} * size + int64_t{plan.packed_biases} * 4, 16) * 16;
  // Many rows amortise the weights, resident weights spare barriers: the first that fits, unless a
  // multiprocessor has few warps of it, and twice as many of a later one.
  struct Shape {
    int row_tiles, warps;
    bool resident;
  };
  constexpr Shape kShapes[] = {{2, 4, true}, {2, 4, false}, {2, 2, true},  {2, 2, false}, {2, 1, false},
                               {1, 4, true}, {1, 4, false}, {1, 2, false}, {1, 1, false}};
  const auto attempt = [&](const Shape& shape) {
    // Forward values take turns in memory: 32 rows of them fit wherever 16 do, and one kernel less is compiled.
    if (!backward && shape.row_tiles == 1) return 0;
    plan.row_tiles = shape.row_tiles;
    plan.warps = shape.warps;
    plan.resident = shape.resident;
    plan.region = place_values(plan, 16 * shape.row_tiles, skew);
    plan.slot = shape.resident ? plan.packed_weights : slot_of(plan, skew);
    const int64_t bytes = (int64_t{plan.region} * shape.warps + plan.slot) * size;
    if (bytes > device.shared_bytes) return 0;
    plan.shared_bytes = static_cast<int>(bytes);
    return mlp_cuda_warps(plan, device);
  };
  const Shape* chosen = nullptr;
  int most = 0;
  for (const Shape& each : kShapes) {
    const int warps = attempt(each);
    if (warps < (chosen == nullptr ? 1 : 2 * most)) continue;
    most = warps;
    chosen = &each;
    if (warps >= kEnoughWarps) break;
  }
  if (chosen == nullptr) return "the values of a warp's rows must fit the shared memory of a block";
  attempt(*chosen);
  const int64_t wanted =
      std::max<int64_t>(1, int64_t{backward ? kBackwardTasks : kForwardTasks} * device.multiprocessors);
  plan.task_rows = ceil_div(std::max<int64_t>(1, ceil_div(n, wanted)), int64_t{plan.rows()}) * plan.rows();
  plan.tasks = n / plan.task_rows + k;  // every cell's last task may be short
  return nullptr;
}

int mlp_cuda_warps(const MlpCudaPlan& plan, const MlpCudaDevice& device) {
  const int by_memory = (device.shared_bytes + kBlockReserve) / (plan.shared_bytes + kBlockReserve);
  // What __launch_bounds__ of the kernels says: registers for as many blocks of four warps.
  return std::min(by_memory * plan.warps, plan.backward ? 8 : 12) / plan.warps * plan.warps;
}

MlpCudaWorkspace mlp_cuda_workspace(const MlpCudaPlan& plan, int64_t k, bool parameters) {
  const auto aligned = [](int64_t bytes) { return ceil_div<int64_t>(bytes, 256) * 256; };
  MlpCudaWorkspace parts{};
  parts.first_task = aligned(plan.packed_bytes * k);
  parts.partials = parts.first_task + aligned(4 * (k + 1));
  parts.bytes = parts.partials + (parameters ? 4 * plan.tasks * plan.partial : 0);
  return parts;
}

}  // namespace voronerf
