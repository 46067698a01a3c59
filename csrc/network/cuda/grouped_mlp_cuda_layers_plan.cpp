#include <algorithm>

#include "common/common.h"
#include "network/cuda/grouped_mlp_cuda_layers.h"
#include "network/grouped_mlp_layout.h"

namespace voronerf {

namespace {

constexpr int kCaches = 4;
constexpr int kTilesPerMultiprocessor = 4;
constexpr int kBlocksPerMultiprocessor = 8;
constexpr int kMostSplits = 64;
constexpr int64_t kMostPartialBytes = int64_t{512} << 20;  // unless one split has more

int64_t pad(int64_t width) { return ceil_div<int64_t>(width, kMlpDepth) * kMlpDepth; }

const char* copy_table(const MlpTable& table, MlpLayersPlan& plan) {
  if (table.position.kind == MlpEncodingKind::hash) return "hash grids must be looked up by tiles";
  plan.positions = mlp_cuda_input(table.positions, table.position);
  plan.directions = mlp_cuda_input(table.directions, table.direction);
  for (const MlpLayer& given : table.layers) {
    MlpLayersLayer layer{};
    if (given.inputs.size() > kLayersParts) return "a layer must have at most 64 sources";
    layer.width = given.width;
    layer.padded = pad(given.width);
    layer.activation = static_cast<int>(given.activation);
    layer.slope = -1;
    for (const int from : given.inputs) {
      const int64_t width = from >= 0 ? plan.layers[from].width : plan.input(from).width;
      if (width < 1) return "a layer's sources must have features";
      layer.sources.push_back({from, width, pad(width), layer.inputs, layer.stride});
      layer.inputs += width;
      layer.stride += pad(width);
    }
    plan.layers.push_back(layer);
  }
  for (const int output : table.outputs) {
    MlpLayersLayer& layer = plan.layers[output];
    if (layer.outputs.size() == kLayersOutputs) return "a layer must be among the outputs at most 8 times";
    layer.outputs.push_back(plan.out_features);
    layer.live = true;
    plan.out_features += layer.width;
  }
  return nullptr;
}

// What is live, and whether as many products can be summed as a value has readers.
const char* find_readers(MlpLayersPlan& plan) {
  std::vector<int> readers(plan.layers.size() + 2, 0);  // of directions, positions, layers
  for (size_t l = plan.layers.size(); l-- > 0;) {
    if (!plan.layers[l].live) continue;
    for (const MlpLayersSource& source : plan.layers[l].sources) {
      if (++readers[source.from + 2] > kLayersParts) return "a layer must be read at most 64 times";
      if (source.from >= 0) plan.layers[source.from].live = true;
      if (source.from == kFromPositions) plan.positions.used = true;
      if (source.from == kFromDirections) plan.directions.used = true;
    }
  }
  return nullptr;
}

void place(MlpLayersPlan& plan, int64_t k) {
  for (MlpCudaInput* input : {&plan.positions, &plan.directions}) {
    input->value = static_cast<int>(plan.columns);
    if (input->used) plan.columns += input->padded;
  }
  for (MlpLayersLayer& layer : plan.layers) {
    layer.weight = plan.packed;
    plan.packed += k * layer.padded * layer.stride;
    layer.partial = plan.partial;
    plan.partial += layer.padded * (layer.stride + 1);
    if (!layer.live) continue;
    layer.value = plan.columns;
    plan.columns += layer.padded;
    if (plan.backward && layer.activation == static_cast<int>(Activation::sine)) {
      layer.slope = plan.columns;
      plan.columns += layer.padded;
    }
  }
}

int64_t widest(const MlpLayersPlan& plan) {
  int64_t width = 1;
  for (const MlpLayersLayer& layer : plan.layers) {
    if (layer.live) width = std::max(width, layer.padded);
  }
  return width;
}

// Whether going layer by layer moves less than half of the bytes that fusing does, for each row.
bool moves_less(int64_t fused, const MlpLayersPlan& layers, int rows) {
  // By layers, a value is written and read; backward its gradient replaces it and enters two products.
  const int64_t by_row = layers.columns * layers.element * (layers.backward ? 6 : 2);
  return fused > 2 * by_row * rows;
}

// Bytes that a block moves for a tile of rows: the weights unless they stay, backward twice, and its partial gradients,
// which it reads and writes.
int64_t bytes_of_tile(const MlpCudaPlan& fused) {
  const int64_t weights = fused.resident ? 0 : fused.packed_bytes;
  return fused.backward ? 2 * weights + 8 * int64_t{fused.partial} : weights;
}

}  // namespace

const char* mlp_layers_plan(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k, bool backward,
                            const MlpCudaDevice& device, MlpLayersPlan& plan) {
  plan = {};
  // What tensor cores cannot multiply before 8.0 is multiplied exactly.
  if (device.capability < 80 && precision != MlpPrecision::float16) precision = MlpPrecision::float32;
  plan.precision = precision;
  plan.backward = backward;
  plan.multiprocessors = device.multiprocessors;
  plan.element = precision == MlpPrecision::bfloat16 || precision == MlpPrecision::float16 ? 2 : 4;
  if (const char* fault = copy_table(table, plan)) return fault;
  if (const char* fault = find_readers(plan)) return fault;
  place(plan, k);
  // A slab's values are a few times the cache, from which most of what a product reads then comes, and fill the device.
  const int64_t cached = kCaches * device.cache_bytes / (plan.columns * plan.element) / kLayersRows;
  const int64_t filling = ceil_div<int64_t>(kTilesPerMultiprocessor * device.multiprocessors,
                                            ceil_div<int64_t>(widest(plan), kLayersColumns));
  const int64_t tiles = std::min(ceil_div<int64_t>(std::max<int64_t>(n, 1), kLayersRows), std::max(cached, filling));
  plan.slab = tiles * kLayersRows;
  plan.slabs = ceil_div(std::max<int64_t>(n, 1), plan.slab);
  plan.tiles = plan.slab / kLayersRows + k;  // every cell's last tile may be short
  // Blocks of the largest layer's gradient fill the device, and each has rows to work on. Of evenly filled cells, which
  // are sorted, a slab has few.
  const int64_t cells = std::min(k, k / plan.slabs + 2);
  int64_t blocks = 1;
  for (const MlpLayersLayer& layer : plan.layers) {
    if (!layer.live) continue;
    for (const MlpLayersSource& source : layer.sources) {
      blocks = std::max(blocks, cells * ceil_div<int64_t>(layer.padded, kLayersRows) *
                                    ceil_div<int64_t>(source.padded, kLayersColumns));
    }
  }
  const int64_t wanted = ceil_div<int64_t>(int64_t{kBlocksPerMultiprocessor} * device.multiprocessors, blocks);
  const int64_t useful = ceil_div<int64_t>(plan.slab, 4 * kLayersRows);
  const int64_t affordable = kMostPartialBytes / std::max<int64_t>(1, 4 * k * plan.partial);
  plan.splits = static_cast<int>(std::max<int64_t>(1, std::min<int64_t>({wanted, useful, affordable, kMostSplits})));
  return nullptr;
}

const char* mlp_cuda_choose(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k, bool backward,
                            MlpCudaWay wanted, const MlpCudaDevice& device, MlpCudaChoice& choice) {
  choice = {};
  // Gradients of what the chain computes are those of the tiles, which compute it again.
  const char* chain =
      backward ? "gradients take tiles or layers" : mlp_chain_plan(table, precision, n, k, device, choice.chain);
  const char* tiles = mlp_cuda_plan(table, precision, n, k, backward, device, choice.fused);
  const char* layers = mlp_layers_plan(table, precision, n, k, backward, device, choice.layers);
  choice.way = wanted;
  if (wanted == MlpCudaWay::chain && !backward) return chain;
  if (wanted == MlpCudaWay::tiles) return tiles;
  if (wanted == MlpCudaWay::layers) return layers;
  const auto fits = [&](const char* fault, int64_t bytes, int rows) {
    return fault == nullptr && (layers != nullptr || !moves_less(bytes, choice.layers, rows));
  };
  if (fits(chain, choice.chain.resident ? 0 : choice.chain.packed_bytes, choice.chain.rows())) {
    choice.way = MlpCudaWay::chain;
  } else if (fits(tiles, bytes_of_tile(choice.fused), choice.fused.rows())) {
    choice.way = MlpCudaWay::tiles;
  } else {
    choice.way = MlpCudaWay::layers;
    return layers;
  }
  return nullptr;
}

bool mlp_cuda_hashes(const MlpTable& table, MlpPrecision precision, MlpCudaWay wanted, const MlpCudaDevice& device) {
  MlpTable encoded = table;
  encoded.positions = encoded_width(table.positions, table.position);
  encoded.position = {};
  for (const bool backward : {false, true}) {
    MlpCudaChoice own, before;
    if (mlp_cuda_choose(table, precision, 1, 1, backward, wanted, device, own) != nullptr) return false;
    if (mlp_cuda_choose(encoded, precision, 1, 1, backward, wanted, device, before) != nullptr) return false;
    if (before.way == MlpCudaWay::layers) return false;
  }
  return true;
}

MlpLayersWorkspace mlp_layers_workspace(const MlpLayersPlan& plan, int64_t k, bool parameters) {
  const auto aligned = [](int64_t bytes) { return ceil_div<int64_t>(bytes, 256) * 256; };
  MlpLayersWorkspace parts{};
  parts.first_task = aligned(plan.packed * plan.element);
  parts.values = parts.first_task + aligned(4 * (k + 1));
  parts.partials = parts.values + aligned(plan.columns * plan.slab * plan.element);
  parts.bytes = parts.partials + (parameters ? 4 * plan.splits * k * plan.partial : 0);
  return parts;
}

}  // namespace voronerf
