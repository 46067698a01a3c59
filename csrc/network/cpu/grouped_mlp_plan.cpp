#include <algorithm>

#include "common/common.h"
#include "network/cpu/grouped_mlp_planner.h"
#include "network/cpu/row_tasks.h"
#include "network/grouped_mlp_layout.h"

namespace voronerf {

namespace {

// Outputs that a row of 16 lanes wastes most of: at most a block's rows, and [outputs][inputs] then fits [inputs][16].
constexpr int64_t kFewOutputs = 6;

// A layer of few outputs as dot products (few_outputs_tile.h): where each source is a tile's buffer of whole vectors.
constexpr int64_t kMostDots = 4, kMostDotSources = 8;

int64_t pad(int64_t width) { return ceil_div(width, kGranule) * kGranule; }

}  // namespace

// Time of the forward pass: 0 inputs, l + 1 layer l. The backward pass follows: layer l at `turn(l)`, the encodings at
// the end.
void MlpPlanner::place_buffers() {
  const int64_t count = plan_.layer_count, end = 2 * count + 2;
  const auto turn = [&](int64_t l) { return 2 * count - l; };
  Arena arena;
  std::vector<int64_t> last_use(count, 0);
  int64_t last_position = 0, last_direction = 0;
  std::vector<int64_t> first_gradient(count, end);
  int64_t position_gradient = end, direction_gradient = end;
  for (int64_t l = 0; l < count; ++l) {
    last_use[l] = std::max(last_use[l],
                           layers_[l].from_output ? end : l + 1);  // outputs are written at the end
    if (!layers_[l].live) continue;
    for (const MlpPlanSource& s : sources_[l]) {
      const bool layer = s.from >= 0;
      int64_t& use = layer ? last_use[s.from] : s.from == kFromPositions ? last_position : last_direction;
      int64_t& first = layer                      ? first_gradient[s.from]
                       : s.from == kFromPositions ? position_gradient
                                                  : direction_gradient;
      use = std::max(use, l + 1);
      first = std::min(first, turn(l));
    }
  }
  const auto buffer = [&](int64_t width, int64_t from, int64_t to) {
    const int64_t stride = pad(width);
    return MlpBuffer{arena.take(stride * plan_.tile, from, to), stride};
  };
  const auto pairs = [&](int64_t width, int64_t from, int64_t to) {
    const int64_t stride = pad(width) / 2;
    return MlpBuffer{arena.take(stride * plan_.tile, from, to), stride};
  };
  const auto place_input = [&](MlpPlanInput& input, int64_t last, int64_t first_contribution) {
    if (!input.used) return;
    input.table = arena.take(3 * pad(input.width), 0, end);
    // One vector more, since the encoder loads a whole one for each row.
    input.staged = {arena.take(pad(input.raw * plan_.tile) + 2 * kGranule, 0, end), input.raw};
    if (input.copied) input.value = buffer(input.width, 0, plan_.gradients ? end : last);
    if (plan_.half) input.narrow = pairs(input.width, 0, plan_.gradients ? end : last);
    if (input.gradient_wanted) input.gradient = buffer(input.width, first_contribution, end);
  };
  place_input(plan_.positions, last_position, position_gradient);
  place_input(plan_.directions, last_direction, direction_gradient);
  for (int64_t l = 0; l < count; ++l) {
    MlpPlanLayer& layer = layers_[l];
    if (!layer.live) continue;
    // With bfloat16 operands, a value that is not an output is read only while it is narrowed.
    const int64_t last = plan_.gradients ? end : plan_.half && !layer.from_output ? l + 1 : last_use[l];
    layer.value = buffer(layer.width, l + 1, last);
    if (plan_.half) layer.narrow = pairs(layer.width, l + 1, plan_.gradients ? end : last_use[l]);
    if (!plan_.gradients) continue;
    if (layer.slope_kept) layer.slope = buffer(layer.width, 0, end);
    layer.gradient = buffer(layer.width, layer.from_output ? count + 1 : first_gradient[l], turn(l));
  }
  for (int64_t l = 0; l < count; ++l) {
    MlpPlanLayer& layer = layers_[l];
    if (!layer.live) continue;
    layer.packed = arena.take(layer.packed_depth * layer.padded, 0, end);
    layer.bias = arena.take(layer.padded, 0, end);
    if (!plan_.gradients) continue;
    for (MlpPlanSource& s : sources_[l]) {
      if (s.gradient) s.packed = arena.take(layer.packed_width * pad(s.width), 0, end);
    }
  }
  if (plan_.half) {
    int64_t widest = 0, packing = 0;
    for (int64_t l = 0; l < count; ++l) {
      widest = std::max(widest, layers_[l].padded);
      packing = std::max(packing, 4 * (layers_[l].packed_depth + kGranule));
      for (const MlpPlanSource& s : sources_[l]) widest = std::max(widest, pad(s.width));
    }
    const int64_t size = pad(std::max(widest * plan_.tile / 2, packing));
    plan_.scratch_input = arena.take(size, 0, end);
    plan_.scratch_output = arena.take(size, 0, end);
  }
  if (plan_.parameter_gradients) plan_.own_partial = arena.take(plan_.partial, 0, end);
  plan_.workspace = arena.total();
}

// A source's gradient is the sum over the layers that read it, last layer first.
void MlpPlanner::order_gradients() {
  const int64_t count = plan_.layer_count;
  std::vector<const MlpPlanSource*> seen(count, nullptr);
  std::vector<MlpPlanSource*> latest(count, nullptr);
  bool positions_seen = false, directions_seen = false;
  for (int64_t l = count; l-- > 0;) {
    if (!layers_[l].live) continue;
    for (MlpPlanSource& s : sources_[l]) {
      const bool few = layers_[l].width <= kFewOutputs && s.width > kGranule;
      if (s.from >= 0) {
        s.gradient = true;
        s.by_outputs = few;
        s.first = seen[s.from] == nullptr && !layers_[s.from].from_output;
        seen[s.from] = latest[s.from] = &s;
      } else {
        bool& before = s.from == kFromPositions ? positions_seen : directions_seen;
        const MlpPlanInput& input = s.from == kFromPositions ? plan_.positions : plan_.directions;
        s.gradient = input.gradient_wanted;
        s.by_outputs = few && input.copied;  // a tile's buffer is padded, the caller's array is not
        s.first = !before;
        before = true;
      }
    }
  }
  for (int64_t l = 0; l < count; ++l) {
    layers_[l].read = latest[l] != nullptr;
    layers_[l].only_output = latest[l] == nullptr && layers_[l].activation == static_cast<int>(Activation::none);
    if (latest[l] == nullptr) continue;
    latest[l]->last = true;
    layers_[l].slope_fused = layers_[l].activation == static_cast<int>(Activation::relu);
  }
}

void MlpPlanner::mark_live(const MlpTable& table) {
  for (const int output : table.outputs) layers_[output].live = layers_[output].from_output = true;
  for (int64_t l = plan_.layer_count; l-- > 0;) {
    if (!layers_[l].live) continue;
    for (const int from : table.layers[l].inputs) {
      if (from >= 0) layers_[from].live = true;
      if (from == kFromPositions) plan_.positions.used = true;
      if (from == kFromDirections) plan_.directions.used = true;
    }
  }
}

MlpPlanner::MlpPlanner(const MlpTable& table, const MlpGathered& gathered, const MlpWanted& wanted) {
  plan_.layer_count = static_cast<int64_t>(table.layers.size());
  plan_.gradients = wanted.parameters || wanted.positions || wanted.directions || wanted.features;
  plan_.parameter_gradients = wanted.parameters;
  plan_.half = wanted.half;
  layers_.resize(table.layers.size());
  sources_.resize(table.layers.size());
  const auto input = [&wanted](int64_t raw, const MlpEncoding& encoding, bool gather, bool gradient) {
    MlpPlanInput it{};
    it.raw = raw;
    it.encoding = encoding;
    it.width = encoded_width(raw, encoding);
    it.copied = encoding.kind != MlpEncodingKind::none || gather || wanted.half;
    it.gradient_wanted = gradient;
    return it;
  };
  const MlpEncoding &position = table.position, &direction = table.direction;
  const bool integrated = position.kind == MlpEncodingKind::integrated;
  VN_CHECK(!integrated || (position.size > 0 && table.positions % 2 == 0),
           "grouped_mlp: the integrated encoding must have octaves and as many means as variances");
  VN_CHECK(position.kind != MlpEncodingKind::hash || table.positions == 3,
           "grouped_mlp: positions that are hashed must have three features");
  plan_.positions = input(table.positions, position, gathered.positions, wanted.positions || wanted.features);
  plan_.directions = input(table.directions, direction, gathered.directions, wanted.directions);

  for (size_t l = 0; l < layers_.size(); ++l) {
    MlpPlanLayer& layer = layers_[l];
    layer.activation = static_cast<int>(table.layers[l].activation);
    layer.width = table.layers[l].width;
    layer.padded = pad(layer.width);
    layer.packed_width = wanted.half ? ceil_div(layer.width, int64_t{2}) : layer.width;
    layer.slope_kept = table.layers[l].activation == Activation::sine;
    for (const int from : table.layers[l].inputs) {
      MlpPlanSource s{};
      s.from = from;
      s.width = from >= 0                ? layers_[from].width
                : from == kFromPositions ? plan_.positions.width
                                         : plan_.directions.width;
      s.row = layer.depth;
      s.packed_row = layer.packed_depth;
      layer.depth += s.width;
      layer.packed_depth += wanted.half ? ceil_div(s.width, int64_t{2}) : s.width;
      sources_[l].push_back(s);
    }
    // The products walk sources and their values with loops that test at the end.
    const bool sound = layer.width > 0 && !sources_[l].empty();
    VN_CHECK(sound && std::all_of(sources_[l].begin(), sources_[l].end(), [](const auto& s) { return s.width > 0; }),
             "grouped_mlp: every layer must have outputs, and inputs from sources that have features");
    const int64_t unit = wanted.half ? 2 * kGranule : kGranule;
    const bool dots = layer.width <= kMostDots && sources_[l].size() <= kMostDotSources &&
                      std::all_of(sources_[l].begin(), sources_[l].end(),
                                  [unit](const auto& s) { return s.from >= 0 && s.width % unit == 0; });
    layer.dots = !dots ? 0 : layer.width == 1 ? 1 : kMostDots;
    layer.sources = sources_[l].data();
    layer.source_count = static_cast<int64_t>(sources_[l].size());
    layer.partial = plan_.partial;
    layer.partial_bias = plan_.partial + layer.depth * layer.padded;
    plan_.partial = layer.partial_bias + layer.padded;
  }
  int64_t column = 0;
  for (const int output : table.outputs) {
    outputs_.push_back({output, column});
    column += layers_[output].width;
  }
  plan_.out_features = column;
  mark_live(table);
  plan_.positions.gradient_wanted &= plan_.positions.used;
  plan_.directions.gradient_wanted &= plan_.directions.used;
  order_gradients();
  plan_.tile = tile_rows();
  place_buffers();
  plan_.layers = layers_.data();
  plan_.outputs = outputs_.data();
  plan_.output_count = static_cast<int64_t>(outputs_.size());
}

}  // namespace voronerf
