// The CPU kernels of grouped_mlp, once for each instruction set.
//
// A tile of 96 samples goes through all layers while its values stay in the first two cache levels; nothing of
// the size of n times a layer is ever written. A cell's weights are packed once by each thread that works on it,
// [inputs][outputs] in panels of 64 columns, so that the products (gemm_tile.h) read them in order. The backward pass
// computes the tile's activations again, then walks the layers from the last to the first: parameter gradients are
// summed over all tiles of a task in one partial, which stays in cache as well.
#include "grouped_mlp_isa.h"

#include "frequency_encode_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Activation as in grouped_mlp.h, which a file compiled per instruction set cannot include: it uses the standard
// library.
constexpr int kRelu = 1, kSoftplus = 2, kSigmoid = 3, kSine = 4;
constexpr int kFromPositions = -1;

VN_INLINE int64_t padded_width(const MlpPlanSource& source) {
  return (source.width + kGranule - 1) / kGranule * kGranule;
}

VN_INLINE int64_t smaller(int64_t a, int64_t b) {
  return a < b ? a : b;
}

// Four rows of `from` become the four columns of `to`; by fours, since weights of small networks are packed often.
VN_INLINE void transpose_four(const float* from, int64_t from_stride, int64_t count, float* to, int64_t to_stride) {
  int64_t i = 0;
#if VN_ISA > 0
  for (; i + 4 <= count; i += 4) {
    __m128 a = _mm_loadu_ps(from + i), b = _mm_loadu_ps(from + from_stride + i);
    __m128 c = _mm_loadu_ps(from + 2 * from_stride + i), d = _mm_loadu_ps(from + 3 * from_stride + i);
    _MM_TRANSPOSE4_PS(a, b, c, d);
    _mm_storeu_ps(to + i * to_stride, a);
    _mm_storeu_ps(to + (i + 1) * to_stride, b);
    _mm_storeu_ps(to + (i + 2) * to_stride, c);
    _mm_storeu_ps(to + (i + 3) * to_stride, d);
  }
#endif
  for (; i < count; ++i) {
    for (int64_t row = 0; row < 4; ++row) to[i * to_stride + row] = from[row * from_stride + i];
  }
}

// weights [o][depth] -> panels [depth][<= 64 of o, padded to 16 with 0].
void pack_forward(const float* weights, const float* bias, const MlpPlanLayer& layer, float* packed,
                  float* packed_bias) {
  for (int64_t first = 0; first < layer.padded; first += kPanel) {
    const int64_t columns = smaller(kPanel, layer.padded - first);
    float* panel = packed + first * layer.depth;
    for (int64_t column = 0; column < columns; column += 4) {
      const int64_t o = first + column;
      if (o + 4 <= layer.width) {
        transpose_four(weights + o * layer.depth, layer.depth, layer.depth, panel + column, columns);
        continue;
      }
      for (int64_t i = 0; i < layer.depth; ++i) {
        for (int64_t c = 0; c < 4; ++c) {
          panel[i * columns + column + c] = o + c < layer.width ? weights[(o + c) * layer.depth + i] : 0.0f;
        }
      }
    }
  }
  for (int64_t o = 0; o < layer.padded; ++o) packed_bias[o] = bias != nullptr && o < layer.width ? bias[o] : 0.0f;
}

// The inputs of one source: weights [o][depth] -> panels [o][<= 64 of its width, padded to 16 with 0].
void pack_backward(const float* weights, const MlpPlanLayer& layer, const MlpPlanSource& source, float* packed) {
  const int64_t padded = padded_width(source);
  for (int64_t first = 0; first < padded; first += kPanel) {
    const int64_t columns = smaller(kPanel, padded - first), count = smaller(columns, source.width - first);
    for (int64_t o = 0; o < layer.width; ++o) {
      const float* from = weights + o * layer.depth + source.row + first;
      for (int64_t c = 0; c < count; ++c) packed[c] = from[c];
      for (int64_t c = count; c < columns; ++c) packed[c] = 0.0f;
      packed += columns;
    }
  }
}

// Few outputs, as heads have, are not worth a call of memcpy.
VN_INLINE void copy_row(const float* from, int64_t width, float* to) {
  if (width == 4) {
    __builtin_memcpy(to, from, 4 * sizeof(float));
    return;
  }
  int64_t c = 0;
  for (; c + kLanes <= width; c += kLanes) store(to + c, load(from + c));
  for (; c < width; ++c) to[c] = from[c];
}

// In place; sine leaves its cosine in `slope` where that is kept.
void activate(const MlpPlanLayer& layer, int64_t rows, float* value, float* slope) {
  const int64_t size = rows * layer.padded;
  for (int64_t i = 0; i < size; i += kLanes) {
    const F32 x = load(value + i);
    if (layer.activation == kSoftplus) {
      store(value + i, softplus(x));
    } else if (layer.activation == kSigmoid) {
      store(value + i, sigmoid(x));
    } else if (beyond_sine(x)) {
      for (int lane = 0; lane < kLanes; ++lane) {
        const float angle = value[i + lane];
        value[i + lane] = __builtin_sinf(angle);
        if (slope != nullptr) slope[i + lane] = __builtin_cosf(angle);
      }
    } else {
      store(value + i, sine(x, splat(0.0f)));
      if (slope != nullptr) store(slope + i, sine(x, splat(0.5f)));
    }
  }
}

// gradient *= the activation's derivative, from its output or, for sine, from the cosine that was kept.
void times_slope(const MlpPlanLayer& layer, int64_t rows, const float* value, const float* slope, float* gradient) {
  const int64_t size = rows * layer.padded;
  const F32 zero = splat(0.0f), one = splat(1.0f);
  for (int64_t i = 0; i < size; i += kLanes) {
    const F32 y = load(value + i), g = load(gradient + i);
    F32 factor = one;
    if (layer.activation == kRelu) factor = y > zero ? one : zero;
    if (layer.activation == kSoftplus) factor = zero - exponential_minus_one(zero - y);
    if (layer.activation == kSigmoid) factor = y * (one - y);
    if (layer.activation == kSine) factor = load(slope + i);
    store(gradient + i, g * factor);
  }
}

// Rows of one tile: where its values are.
struct Tile {
  const MlpPlan& plan;
  const MlpData& data;
  float* workspace;
  int64_t begin, rows;

  float* at(const MlpBuffer& buffer) const { return workspace + buffer.offset; }

  Source source(int from, int64_t width) const {
    if (from >= 0) return {at(plan.layers[from].value), plan.layers[from].value.stride, width};
    const MlpPlanInput& input = from == kFromPositions ? plan.positions : plan.directions;
    if (input.copied) return {at(input.value), input.value.stride, width};
    return {(from == kFromPositions ? data.positions : data.directions) + begin * input.raw, input.raw, width};
  }

  // Raw features, gathered by `index` where there is one, to what the layers read.
  void read_input(const MlpPlanInput& input, const float* raw, const int32_t* index) const {
    if (!input.used || !input.copied) return;
    const bool encoded = input.octaves >= 0;
    float* staged = encoded ? at(input.staged) : at(input.value);
    const int64_t stride = encoded ? input.raw : input.value.stride;
    if (index == nullptr && stride == input.raw) {
      __builtin_memcpy(staged, raw + begin * input.raw, sizeof(float) * rows * input.raw);
    } else {
      for (int64_t row = 0; row < rows; ++row) {
        const int64_t from = index == nullptr ? begin + row : index[begin + row];
        for (int64_t f = 0; f < input.raw; ++f) staged[row * stride + f] = raw[from * input.raw + f];
      }
    }
    if (encoded) {
      encode(staged, workspace + input.table, rows, input.raw, input.octaves, at(input.value), input.value.stride);
    }
  }

  // The values of all layers that reach an output; `heads` false leaves out those that only do.
  void run_layers(bool heads) const {
    read_input(plan.positions, data.positions, nullptr);
    read_input(plan.directions, data.directions, data.direction_index);
    for (int64_t l = 0; l < plan.layer_count; ++l) {
      const MlpPlanLayer& layer = plan.layers[l];
      if (layer.live && (heads || !layer.only_output)) run_layer(layer);
    }
  }

  void run_layer(const MlpPlanLayer& layer) const {
    constexpr int64_t kFew = 8;
    float* value = at(layer.value);
    // Sources in groups of kFew: a longer concatenation continues on its own result.
    for (int64_t group = 0, row = 0; group < layer.source_count; group += kFew) {
      Source sources[kFew];
      const int64_t count = smaller(kFew, layer.source_count - group);
      int64_t depth = 0;
      for (int64_t s = 0; s < count; ++s) {
        sources[s] = source(layer.sources[group + s].from, layer.sources[group + s].width);
        depth += sources[s].depth;
      }
      const bool relu = layer.activation == kRelu && group + count == layer.source_count;
      for (int64_t first = 0; first < layer.padded; first += kPanel) {
        const int64_t columns = smaller(kPanel, layer.padded - first);
        const float* b = workspace + layer.packed + first * layer.depth + row * columns;
        const float* start = group > 0 ? value + first : workspace + layer.bias + first;
        multiply<false>({sources, count, b, columns, start, group > 0 ? layer.padded : 0, value + first, layer.padded,
                         relu ? Finish::relu : Finish::none, nullptr},
                        rows, columns);
      }
      row += depth;
    }
    if (layer.activation > kRelu) {
      activate(layer, rows, value, layer.slope_kept && plan.gradients ? at(layer.slope) : nullptr);
    }
  }

  void write_outputs() const {
    for (int64_t i = 0; i < plan.output_count; ++i) {
      const MlpPlanLayer& layer = plan.layers[plan.outputs[i].layer];
      const float* value = at(layer.value);
      float* out = data.out + begin * plan.out_features + plan.outputs[i].column;
      for (int64_t row = 0; row < rows; ++row, value += layer.padded, out += plan.out_features) {
        copy_row(value, layer.width, out);
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
        const float* from = data.grad_out + begin * plan.out_features + plan.outputs[i].column;
        for (int64_t row = 0; row < rows; ++row) {
          for (int64_t c = 0; c < layer.width; ++c)
            gradient[row * layer.padded + c] += from[row * plan.out_features + c];
        }
      }
    }
  }

  // Adds to the partial, or fills it if this is the task's first tile.
  void parameter_gradients(const MlpPlanLayer& layer, float* partial, bool fill) const {
    const float* gradient = at(layer.gradient);
    float* bias = partial + layer.partial_bias;
    for (int64_t first = 0; first < layer.padded; first += kLanes) {
      F32 sum = fill ? splat(0.0f) : load(bias + first);
      for (int64_t row = 0; row < rows; ++row) sum = sum + load(gradient + row * layer.padded + first);
      store(bias + first, sum);
    }
    for (int64_t i = 0; i < layer.source_count; ++i) {
      const MlpPlanSource& s = layer.sources[i];
      const Source input = source(s.from, rows), output = {gradient, layer.padded, rows};
      float* c = partial + layer.partial + s.row * layer.padded;
      if (s.by_outputs) {
        weight_gradient(output, layer.width, input, padded_width(s), c, fill);
      } else {
        weight_gradient(input, s.width, output, layer.padded, c, fill);
      }
    }
  }

  // c [a_width][b_width] = sum over the rows of a's values times b's, b_width padded.
  static void weight_gradient(const Source& a, int64_t a_width, const Source& b, int64_t b_width, float* c, bool fill) {
    for (int64_t first = 0; first < b_width; first += kPanel) {
      multiply<true>({&a, 1, b.data + first, b.stride, fill ? kZeros : c + first, fill ? 0 : b_width, c + first,
                      b_width, Finish::none, nullptr},
                     a_width, smaller(kPanel, b_width - first));
    }
  }

  void source_gradient(const MlpPlanLayer& layer, const MlpPlanSource& s) const {
    const MlpBuffer& to = s.from >= 0                ? plan.layers[s.from].gradient
                          : s.from == kFromPositions ? plan.positions.gradient
                                                     : plan.directions.gradient;
    const bool fused = s.last && s.from >= 0 && plan.layers[s.from].slope_fused;
    const float* slope = fused ? at(plan.layers[s.from].value) : nullptr;
    const Source a = {at(layer.gradient), layer.gradient.stride, layer.width};
    for (int64_t first = 0; first < to.stride; first += kPanel) {
      const int64_t columns = smaller(kPanel, to.stride - first);
      float* c = at(to) + first;
      multiply<false>(
          {&a, 1, workspace + s.packed + first * layer.width, columns, s.first ? kZeros : c, s.first ? 0 : to.stride, c,
           to.stride, fused ? Finish::relu_slope : Finish::none, fused ? slope + first : nullptr},
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
      for (int64_t s = 0; s < layer.source_count; ++s) {
        if (layer.sources[s].gradient) source_gradient(layer, layer.sources[s]);
      }
    }
    input_gradient(plan.positions, data.grad_positions);
    input_gradient(plan.directions, data.grad_directions);
  }

  void input_gradient(const MlpPlanInput& input, float* out) const {
    if (!input.gradient_wanted) return;
    const float* value = input.octaves >= 0 ? at(input.value) : nullptr;
    encode_backward(value, at(input.gradient), workspace + input.table, rows, input.raw,
                    input.octaves >= 0 ? input.octaves : 0, input.gradient.stride, out + begin * input.raw);
  }
};

}  // namespace

void mlp_prepare(const MlpPlan& plan, float* workspace) {
  const MlpPlanInput* inputs[] = {&plan.positions, &plan.directions};
  for (const MlpPlanInput* input : inputs) {
    if (input->used && input->octaves >= 0) {
      encode_table(workspace + input->table, input->value.stride, input->raw, input->octaves);
    }
  }
}

void mlp_pack(const MlpPlan& plan, const MlpData& data, int64_t cell, float* workspace) {
  for (int64_t l = 0; l < plan.layer_count; ++l) {
    const MlpPlanLayer& layer = plan.layers[l];
    if (!layer.live) continue;
    const float* weights = data.weights[l] + cell * layer.width * layer.depth;
    const float* bias = data.biases[l] == nullptr ? nullptr : data.biases[l] + cell * layer.width;
    pack_forward(weights, bias, layer, workspace + layer.packed, workspace + layer.bias);
    if (!plan.gradients) continue;
    for (int64_t s = 0; s < layer.source_count; ++s) {
      if (layer.sources[s].gradient)
        pack_backward(weights, layer, layer.sources[s], workspace + layer.sources[s].packed);
    }
  }
}

void mlp_forward(const MlpPlan& plan, const MlpData& data, int64_t begin, int64_t end, float* workspace) {
  for (int64_t row = begin; row < end; row += plan.tile) {
    const Tile tile{plan, data, workspace, row, smaller(plan.tile, end - row)};
    tile.run_layers(true);
    tile.write_outputs();
  }
}

void mlp_backward(const MlpPlan& plan, const MlpData& data, int64_t begin, int64_t end, float* workspace,
                  float* partial) {
  for (int64_t row = begin; row < end; row += plan.tile) {
    const Tile tile{plan, data, workspace, row, smaller(plan.tile, end - row)};
    tile.run_layers(false);
    tile.run_gradients(partial, row == begin);
  }
}

void mlp_reduce(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t l, float* partials, int64_t count) {
  const MlpPlanLayer& layer = plan.layers[l];
  float* weights = data.grad_weights[l] + cell * layer.width * layer.depth;
  float* bias = data.grad_biases[l] == nullptr ? nullptr : data.grad_biases[l] + cell * layer.width;
  if (count == 0 || !layer.live) {
    for (int64_t i = 0; i < layer.width * layer.depth; ++i) weights[i] = 0.0f;
    for (int64_t o = 0; bias != nullptr && o < layer.width; ++o) bias[o] = 0.0f;
    return;
  }
  float* sum = partials + layer.partial;
  const int64_t size = (layer.depth + 1) * layer.padded;  // the bias follows the weights
  for (int64_t part = 1; part < count; ++part) {
    const float* next = sum + part * plan.partial;
    for (int64_t i = 0; i < size; i += kLanes) store(sum + i, load(sum + i) + load(next + i));
  }
  for (int64_t i = 0; i < layer.source_count; ++i) {
    const MlpPlanSource& s = layer.sources[i];
    const float* from = sum + s.row * layer.padded;
    float* to = weights + s.row;
    const int64_t by_o = s.by_outputs ? padded_width(s) : 1, by_input = s.by_outputs ? 1 : layer.padded;
    for (int64_t o = 0; o < layer.width; ++o) {
      for (int64_t c = 0; c < s.width; ++c) to[o * layer.depth + c] = from[c * by_input + o * by_o];
    }
  }
  for (int64_t o = 0; bias != nullptr && o < layer.width; ++o) bias[o] = partials[layer.partial_bias + o];
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
