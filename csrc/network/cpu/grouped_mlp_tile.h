// A tile of samples through the network of a cell, forward and backward; see grouped_mlp_isa.cpp.
#pragma once

#include "network/cpu/activation_tile.h"
#include "network/cpu/encoding_tile.h"
#include "network/cpu/few_outputs_tile.h"
#include "network/cpu/grouped_mlp_pack.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// As in grouped_mlp.h, which a file compiled per instruction set cannot include.
constexpr int kFromPositions = -1;

// Wide rows that are gathered follow no pattern that the processor foresees: they are asked for this many rows ahead
// (63 features: 1.24 times the time of sorted rows without, 1.04 with it and whole vectors).
constexpr int64_t kAhead = 8;

VN_INLINE void prefetch(const float* row, int64_t width) {
  for (int64_t c = 0; c < width; c += 16) __builtin_prefetch(row + c);
}

// Rows of one tile: where its values are.
struct Tile {
  const MlpPlan& plan;
  const MlpData& data;
  const HashEncoding& hash;  // of the cell
  float* workspace;
  int64_t begin, rows;

  float* at(const MlpBuffer& buffer) const { return workspace + buffer.offset; }

  // An input as encoded, and the gradient of that: in the workspace, or in the memory of hashed positions.
  float* value(const MlpPlanInput& input) const {
    const bool outside = &input == &plan.positions && data.hashed != nullptr;
    return outside ? data.hashed + begin * input.value.stride : at(input.value);
  }
  float* gradient(const MlpPlanInput& input) const {
    const bool outside = &input == &plan.positions && data.hashed_gradient != nullptr;
    return outside ? data.hashed_gradient + begin * input.gradient.stride : at(input.gradient);
  }

  // Where a row of the tile lies in the caller's arrays.
  int64_t place(int64_t row) const { return data.order == nullptr ? begin + row : data.order[begin + row]; }

  // A row of k for every sample: floats, or pairs.
  Source source(int from, int64_t width) const {
#if VN_HALF
    const MlpBuffer& pairs = from >= 0                ? plan.layers[from].narrow
                             : from == kFromPositions ? plan.positions.narrow
                                                      : plan.directions.narrow;
    return {at(pairs), pairs.stride, (width + 1) / 2};
#else
    if (from >= 0) return {at(plan.layers[from].value), plan.layers[from].value.stride, width};
    const MlpPlanInput& input = from == kFromPositions ? plan.positions : plan.directions;
    if (input.copied) return {value(input), input.value.stride, width};
    return {(from == kFromPositions ? data.positions : data.directions) + begin * input.raw, input.raw, width};
#endif
  }

  // Raw features, gathered by order and `index` where there are any, to what the layers read.
  void read_input(const MlpPlanInput& input, const float* raw, const int32_t* index) const {
    if (!input.used || !input.copied) return;
    const bool encoded = input.encoding.kind != MlpEncodingKind::none;
    float* staged = encoded ? at(input.staged) : at(input.value);
    const int64_t stride = encoded ? input.raw : input.value.stride;
    if (index == nullptr && data.order == nullptr && stride == input.raw) {
      __builtin_memcpy(staged, raw + begin * input.raw, sizeof(float) * rows * input.raw);
    } else {
      const bool scattered = data.order != nullptr && index == nullptr && input.raw >= kGranule;
      for (int64_t row = 0; row < rows; ++row) {
        const int64_t from = index == nullptr ? place(row) : index[place(row)];
        if (scattered && row + kAhead < rows) {
          prefetch(raw + place(row + kAhead) * input.raw, input.raw);
        }
        copy_row(raw + from * input.raw, input.raw, staged + row * stride);
      }
    }
#if VN_HALF
    float* const pairs = at(input.narrow);
#else
    float* const pairs = nullptr;
#endif
    encode_input(input, hash, staged, stride, workspace + input.table, rows, value(input), pairs,
                 plan.gradients || data.encoded);
  }

  // The values of all layers that reach an output; `heads` false leaves out those that only do.
  void run_layers(bool heads) const {
    read_input(plan.positions, data.positions, nullptr);
    if (data.sorted_positions != nullptr) {
      const int64_t raw = plan.positions.raw;
      __builtin_memcpy(data.sorted_positions + begin * raw, at(plan.positions.staged), sizeof(float) * rows * raw);
    }
    read_input(plan.directions, data.directions, data.direction_index);
    for (int64_t l = 0; l < plan.layer_count; ++l) {
      const MlpPlanLayer& layer = plan.layers[l];
      if (layer.live && (heads || !layer.only_output)) run_layer(layer);
    }
  }

  void run_layer(const MlpPlanLayer& layer) const {
    constexpr int64_t kFew = 8;
    float* value = at(layer.value);
    // What layers read leaves the product as pairs where whole vectors of them fit; else it is narrowed afterwards. So
    // is an odd width, whose last pair would hold a column of padding: not zero where a row is not finite.
    const bool narrowed = VN_HALF && layer.read && layer.activation <= kRelu && layer.padded % (2 * kGranule) == 0 &&
                          layer.width % 2 == 0;
    // Sources in groups of kFew: a longer concatenation continues on its own result.
    for (int64_t group = 0, row = 0; group < layer.source_count; group += kFew) {
      Source sources[kFew];
      const int64_t count = smaller(kFew, layer.source_count - group);
      int64_t depth = 0;
      for (int64_t s = 0; s < count; ++s) {
        sources[s] = source(layer.sources[group + s].from, layer.sources[group + s].width);
        depth += sources[s].depth;
      }
      if (layer.dots > 0) {
        const auto run = layer.dots == 1 ? few_outputs<1> : few_outputs<4>;
        run(sources, count, workspace + layer.packed, layer.packed_depth, workspace + layer.bias,
            layer.activation == kRelu, rows, value);
        break;
      }
      const bool last = group + count == layer.source_count;
      const bool pairs = narrowed && last;
      const bool kept = !pairs || plan.gradients || layer.from_output;
      for (int64_t first = 0; first < layer.padded; first += kPanel) {
        const int64_t columns = smaller(kPanel, layer.padded - first);
        const float* b = workspace + layer.packed + first * layer.packed_depth + row * columns;
        const float* start = group > 0 ? value + first : workspace + layer.bias + first;
        multiply<false>(
            {sources, count, b, columns, start, group > 0 ? layer.padded : 0, kept ? value + first : nullptr,
             layer.padded, last && layer.activation == kRelu ? Finish::relu : Finish::none, nullptr,
             pairs ? at(layer.narrow) + first / 2 : nullptr, layer.narrow.stride},
            rows, columns);
      }
      row += depth;
    }
    if (layer.activation > kRelu) {
      activate(layer, rows, value, layer.slope_kept && plan.gradients ? at(layer.slope) : nullptr);
    }
#if VN_HALF
    if (layer.read && !narrowed) narrow(value, layer.padded, layer.width, rows, at(layer.narrow));
#endif
  }

  void write_outputs() const {
    for (int64_t i = 0; i < plan.output_count; ++i) {
      const MlpPlanLayer& layer = plan.layers[plan.outputs[i].layer];
      const float* value = at(layer.value);
      float* out = data.out + plan.outputs[i].column;
      for (int64_t row = 0; row < rows; ++row, value += layer.padded) {
        copy_row(value, layer.width, out + place(row) * plan.out_features);
      }
    }
  }

  void read_output_gradients() const {
    for (int64_t l = 0; l < plan.layer_count; ++l) {
      const MlpPlanLayer& layer = plan.layers[l];
      if (!layer.from_output) continue;
      float* gradient = at(layer.gradient);
      for (int64_t i = 0; i < rows * layer.padded; ++i) gradient[i] = 0.0f;
      for (int64_t i = 0; i < plan.output_count; ++i) {
        if (plan.outputs[i].layer != l) continue;
        for (int64_t row = 0; row < rows; ++row) {
          const float* from = data.grad_out + place(row) * plan.out_features + plan.outputs[i].column;
          for (int64_t c = 0; c < layer.width; ++c) gradient[row * layer.padded + c] += from[c];
        }
      }
    }
  }

  // Adds to the partial, or fills it if this is the task's first tile.
  void parameter_gradients(const MlpPlanLayer& layer, float* partial, bool fill) const {
    const float* gradient = at(layer.gradient);
    float* bias = partial + layer.partial_bias;
    for (int64_t first = 0; first < layer.padded; first += kLanes) {
      // Four sums, or every addition waits for the one before.
      F32 sums[4] = {fill ? splat(0.0f) : load(bias + first), splat(0.0f), splat(0.0f), splat(0.0f)};
      const float* from = gradient + first;
      int64_t row = 0;
      for (; row + 4 <= rows; row += 4) {
        for (int i = 0; i < 4; ++i, from += layer.padded) sums[i] = sums[i] + load(from);
      }
      for (; row < rows; ++row, from += layer.padded) sums[0] = sums[0] + load(from);
      store(bias + first, (sums[0] + sums[1]) + (sums[2] + sums[3]));
    }
    Source output = {gradient, layer.padded, rows};
#if VN_HALF
    interleave_rows(gradient, layer.padded, rows, workspace + plan.scratch_output);
    output = {workspace + plan.scratch_output, layer.padded, (rows + 1) / 2};
#endif
    for (int64_t i = 0; i < layer.source_count; ++i) {
      const MlpPlanSource& s = layer.sources[i];
      const Source input = by_samples(s);
      float* c = partial + layer.partial + s.row * layer.padded;
      if (s.by_outputs) {
        weight_gradient(output, layer.width, input, padded_width(s), c, fill);
      } else {
        weight_gradient(input, s.width, output, layer.padded, c, fill);
      }
    }
  }

  // A source's values with the samples as k.
  Source by_samples(const MlpPlanSource& s) const {
#if VN_HALF
    const MlpPlanInput& input = s.from == kFromPositions ? plan.positions : plan.directions;
    const int64_t stride = s.from >= 0 ? plan.layers[s.from].value.stride : input.value.stride;
    const float* from = s.from >= 0 ? at(plan.layers[s.from].value) : value(input);
    interleave_rows(from, stride, rows, workspace + plan.scratch_input);
    return {workspace + plan.scratch_input, stride, (rows + 1) / 2};
#else
    return source(s.from, rows);
#endif
  }

  // c [a_width][b_width] = sum over the rows of a's values times b's, b_width padded.
  static void weight_gradient(const Source& a, int64_t a_width, const Source& b, int64_t b_width, float* c, bool fill) {
    for (int64_t first = 0; first < b_width; first += kPanel) {
      multiply<true>({&a, 1, b.data + first, b.stride, fill ? kZeros : c + first, fill ? 0 : b_width, c + first,
                      b_width, Finish::none, nullptr, nullptr, 0},
                     a_width, smaller(kPanel, b_width - first));
    }
  }

  // `a`: the layer's gradient, a row of k for every sample.
  void source_gradient(const MlpPlanLayer& layer, const MlpPlanSource& s, const Source& a) const {
    const MlpPlanInput& input = s.from == kFromPositions ? plan.positions : plan.directions;
    const int64_t stride = s.from >= 0 ? plan.layers[s.from].gradient.stride : input.gradient.stride;
    float* const to = s.from >= 0 ? at(plan.layers[s.from].gradient) : gradient(input);
    const bool fused = s.last && s.from >= 0 && plan.layers[s.from].slope_fused;
    const float* slope = fused ? at(plan.layers[s.from].value) : nullptr;
    for (int64_t first = 0; first < stride; first += kPanel) {
      const int64_t columns = smaller(kPanel, stride - first);
      float* c = to + first;
      multiply<false>({&a, 1, workspace + s.packed + first * layer.packed_width, columns, s.first ? kZeros : c,
                       s.first ? 0 : stride, c, stride, fused ? Finish::relu_slope : Finish::none,
                       fused ? slope + first : nullptr, nullptr, 0},
                      rows, columns);
    }
  }

  void run_gradients(float* partial, bool fill) const {
    read_output_gradients();
    for (int64_t l = plan.layer_count; l-- > 0;) {
      const MlpPlanLayer& layer = plan.layers[l];
      if (!layer.live) continue;
      if (layer.activation > 0 && !layer.slope_fused) {
        const float* slope = layer.slope_kept ? at(layer.slope) : nullptr;
        times_slope(layer, rows, at(layer.value), slope, at(layer.gradient));
      }
      if (plan.parameter_gradients) parameter_gradients(layer, partial, fill);
      Source a = {at(layer.gradient), layer.gradient.stride, layer.width};
#if VN_HALF
      narrow(a.data, a.stride, layer.width, rows, workspace + plan.scratch_output);
      a = {workspace + plan.scratch_output, a.stride / 2, (layer.width + 1) / 2};
#endif
      for (int64_t s = 0; s < layer.source_count; ++s) {
        if (layer.sources[s].gradient) source_gradient(layer, layer.sources[s], a);
      }
    }
    input_gradient(plan.positions, data.grad_positions, false);
    input_gradient(plan.directions, data.grad_directions, data.direction_index != nullptr);
  }

  void input_gradient(const MlpPlanInput& input, float* out, bool sorted) const {
    if (!input.gradient_wanted || out == nullptr) return;
    const auto row_of = [&](int64_t row) { return out + (sorted ? begin + row : place(row)) * input.raw; };
    if (has_points(input)) {
      float* points = at(input.staged);
      points_backward(input, hash, gradient(input), rows, points);
      for (int64_t row = 0; row < rows; ++row) copy_row(points + row * input.raw, input.raw, row_of(row));
      return;
    }
    const int64_t stride = input.gradient.stride;
    const float* given = gradient(input);
    // Without octaves values are walked but not read.
    const float* encoded = has_octaves(input) ? at(input.value) : given;
    for (int64_t row = 0; row < rows; ++row, encoded += stride, given += stride) {
      waves_backward(input, encoded, given, workspace + input.table, row_of(row));
    }
  }
};

void pack_cell(const MlpPlan& plan, const MlpData& data, int64_t cell, float* workspace) {
  for (int64_t l = 0; l < plan.layer_count; ++l) {
    const MlpPlanLayer& layer = plan.layers[l];
    if (!layer.live) continue;
    const float* weights = data.weights[l] + cell * layer.width * layer.depth;
    const float* bias = data.biases[l] == nullptr ? nullptr : data.biases[l] + cell * layer.width;
    if (layer.dots > 0) {
      pack_dots(weights, layer, workspace + layer.packed);
    } else {
      pack_forward(weights, layer, workspace + layer.packed, workspace + plan.scratch_input);
    }
    float* packed_bias = workspace + layer.bias;
    for (int64_t o = 0; o < layer.padded; ++o) packed_bias[o] = bias != nullptr && o < layer.width ? bias[o] : 0.0f;
    if (!plan.gradients) continue;
    for (int64_t s = 0; s < layer.source_count; ++s) {
      if (layer.sources[s].gradient)
        pack_backward(weights, layer, layer.sources[s], workspace + layer.sources[s].packed);
    }
  }
}

// run(tile) for each tile of rows [begin, end) of a cell.
template <typename Run>
VN_INLINE void for_tiles(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                         float* workspace, const Run& run) {
  HashEncoding hash;
  if (data.hash != nullptr) hash = hash_of_cell(*data.hash, cell, workspace + plan.positions.staged.offset);
  for (int64_t row = begin; row < end; row += plan.tile) {
    run(Tile{plan, data, hash, workspace, row, smaller(plan.tile, end - row)});
  }
}

void run_forward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end, float* workspace) {
  for_tiles(plan, data, cell, begin, end, workspace, [](const Tile& tile) {
    tile.run_layers(true);
    tile.write_outputs();
  });
}

void run_backward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end, float* workspace,
                  float* partial) {
  for_tiles(plan, data, cell, begin, end, workspace, [partial, begin](const Tile& tile) {
    tile.run_layers(false);
    tile.run_gradients(partial, tile.begin == begin);
  });
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
