// A tile of samples through the layer of a cell, forward and backward; see grouped_linear_isa.cpp.
#pragma once

#include "network/cpu/activation_tile.h"
#include "network/cpu/grouped_linear_isa.h"
#include "network/cpu/grouped_mlp_pack.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// bfloat16 is the upper half of a float32. Plain loops: the compiler makes vectors of them.
VN_INLINE void widen_row(const uint16_t* from, int64_t width, float* to) {
  for (int64_t c = 0; c < width; ++c) {
    const uint32_t bits = static_cast<uint32_t>(from[c]) << 16;
    __builtin_memcpy(to + c, &bits, sizeof bits);
  }
}

// To the nearest, ties to even; NaN stays NaN.
VN_INLINE void round_row(const float* from, int64_t width, uint16_t* to) {
#if VN_HALF
  for (int64_t c = 0; c < width; c += kLanes) {
    const int64_t count = smaller(kLanes, width - c);
    const __m256i rounded = (__m256i)_mm512_cvtneps_pbh(load_some(from + c, count));
    _mm256_mask_storeu_epi16(to + c, static_cast<__mmask16>((1u << count) - 1u), rounded);
  }
#else
  for (int64_t c = 0; c < width; ++c) {
    uint32_t bits;
    __builtin_memcpy(&bits, from + c, sizeof bits);
    const uint32_t rounded = (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
    to[c] = static_cast<uint16_t>((bits & 0x7fffffffu) > 0x7f800000u ? (bits >> 16) | 0x40u : rounded);
  }
#endif
}

// `width` stored values -> floats, then zeros up to `padded`.
VN_INLINE void read_row(const LinearCall& call, const void* from, int64_t at, int64_t width, int64_t padded,
                        float* to) {
  if (call.bfloat16) {
    widen_row(static_cast<const uint16_t*>(from) + at, width, to);
  } else {
    copy_row(static_cast<const float*>(from) + at, width, to);
  }
  for (int64_t c = width; c < padded; ++c) to[c] = 0.0f;
}

VN_INLINE void write_row(const LinearCall& call, const float* from, int64_t width, void* to, int64_t at) {
  if (call.bfloat16) {
    round_row(from, width, static_cast<uint16_t*>(to) + at);
  } else {
    copy_row(from, width, static_cast<float*>(to) + at);
  }
}

#if VN_HALF

// 32 stored values of a row from column c on, zeros from `width` on.
VN_INLINE __m512i load_halves(const uint16_t* row, int64_t c, int64_t width) {
  const int64_t count = width - c;
  const __mmask32 mask = count >= 32 ? 0xffffffffu : count <= 0 ? 0u : (1u << count) - 1u;
  return _mm512_maskz_loadu_epi16(mask, row + c);
}

// bfloat16 [rows][width] -> [(rows + 1) / 2][stride] pairs of neighbouring rows, filled up with 0; stride a multiple of
// 32.
VN_INLINE void interleave_halves(const uint16_t* from, int64_t width, int64_t rows, float* to, int64_t stride) {
  const __m512i low = _mm512_set_epi16(47, 15, 46, 14, 45, 13, 44, 12, 43, 11, 42, 10, 41, 9, 40, 8, 39, 7, 38, 6, 37,
                                       5, 36, 4, 35, 3, 34, 2, 33, 1, 32, 0);
  const __m512i high = _mm512_set_epi16(63, 31, 62, 30, 61, 29, 60, 28, 59, 27, 58, 26, 57, 25, 56, 24, 55, 23, 54, 22,
                                        53, 21, 52, 20, 51, 19, 50, 18, 49, 17, 48, 16);
  for (int64_t row = 0; row < rows; row += 2, from += 2 * width, to += stride) {
    for (int64_t c = 0; c < stride; c += 2 * kLanes) {
      const __m512i even = load_halves(from, c, width);
      const __m512i odd = row + 1 < rows ? load_halves(from + width, c, width) : _mm512_setzero_si512();
      store(to + c, (F32)_mm512_permutex2var_epi16(even, low, odd));
      store(to + c + kLanes, (F32)_mm512_permutex2var_epi16(even, high, odd));
    }
  }
}

#endif

// Rows of one tile.
struct LinearTile {
  const LinearCall& call;
  float* workspace;
  int64_t begin, rows;

  int64_t inputs() const { return call.source.width; }
  int64_t outputs() const { return call.layer.width; }
  const uint16_t* halves() const { return static_cast<const uint16_t*>(call.x) + begin * inputs(); }

  // A row of k for every sample: x itself where it has the form of operands.
  Source source() const {
    float* staged = workspace + call.input;
#if VN_HALF
    // Rows of an even width that start at a whole float are pairs already.
    if (inputs() % 2 == 0 && reinterpret_cast<uintptr_t>(call.x) % sizeof(float) == 0) {
      return {reinterpret_cast<const float*>(halves()), inputs() / 2, inputs() / 2};
    }
    const int64_t stride = call.inputs_padded / 2;
    for (int64_t row = 0; row < rows; ++row) {
      for (int64_t c = 0; c < call.inputs_padded; c += 2 * kLanes) {
        store(staged + row * stride + c / 2, (F32)load_halves(halves() + row * inputs(), c, inputs()));
      }
    }
    return {staged, stride, (inputs() + 1) / 2};
#else
    if (!call.bfloat16) return {static_cast<const float*>(call.x) + begin * inputs(), inputs(), inputs()};
    widen_row(halves(), rows * inputs(), staged);
    return {staged, inputs(), inputs()};
#endif
  }

  // Outputs: to `value` [rows][padded] in floats, or where `stored` says so, and they have the form, to `out` itself.
  // Returns whether they went there.
  bool product(const Source& x, bool stored) const {
    const MlpPlanLayer& layer = call.layer;
    const bool relu = layer.activation == kRelu;
    const int64_t whole = VN_HALF ? 2 * kGranule : kGranule;
    const bool direct = stored && layer.activation <= kRelu && outputs() % whole == 0 && call.bfloat16 == VN_HALF;
    float* out = direct ? static_cast<float*>(call.out) + begin * outputs() / (VN_HALF ? 2 : 1) : nullptr;
    float* c = direct && !VN_HALF ? out : workspace + call.value;
    for (int64_t first = 0; first < layer.padded; first += kPanel) {
      const int64_t columns = smaller(kPanel, layer.padded - first);
      multiply<false>(
          {&x, 1, workspace + layer.packed + first * layer.packed_depth, columns, workspace + layer.bias + first, 0,
           direct && VN_HALF ? nullptr : c + first, layer.padded, relu ? Finish::relu : Finish::none, nullptr,
           direct && VN_HALF ? out + first / 2 : nullptr, outputs() / 2},
          rows, columns);
    }
    return direct;
  }

  void forward() const {
    if (product(source(), true)) return;
    const MlpPlanLayer& layer = call.layer;
    const float* value = workspace + call.value;
    if (layer.activation > kRelu) activate(layer, rows, workspace + call.value, nullptr);
    for (int64_t row = 0; row < rows; ++row) {
      write_row(call, value + row * layer.padded, outputs(), call.out, (begin + row) * outputs());
    }
  }

  void backward(float* partial, bool fill) const {
    const MlpPlanLayer& layer = call.layer;
    float* gradient = workspace + call.gradient;
    for (int64_t row = 0; row < rows; ++row) {
      read_row(call, call.grad_out, (begin + row) * outputs(), outputs(), layer.padded, gradient + row * layer.padded);
    }
    Source x = {nullptr, 0, 0};
    if (layer.activation > 0) {
      x = source();
      product(x, false);
      float *value = workspace + call.value, *slope = layer.slope_kept ? workspace + call.slope : nullptr;
      if (layer.activation > kRelu) activate(layer, rows, value, slope);
      times_slope(layer, rows, value, slope, gradient);
    }
    if (call.grad_weight != nullptr) parameter_gradients(x, gradient, partial, fill);
    if (call.grad_x != nullptr) input_gradient(gradient);
  }

  // Adds to the partial, or fills it if this is the task's first tile.
  void parameter_gradients(Source x, const float* gradient, float* partial, bool fill) const {
    const int64_t padded = call.layer.padded;
    float* bias = partial + inputs() * padded;
    for (int64_t first = 0; first < padded; first += kLanes) {
      F32 sum = fill ? splat(0.0f) : load(bias + first);
      for (int64_t row = 0; row < rows; ++row) sum = sum + load(gradient + row * padded + first);
      store(bias + first, sum);
    }
#if VN_HALF
    x = {workspace + call.scratch_input, call.inputs_padded, (rows + 1) / 2};
    interleave_halves(halves(), inputs(), rows, workspace + call.scratch_input, call.inputs_padded);
    interleave_rows(gradient, padded, rows, workspace + call.scratch_output);
    gradient = workspace + call.scratch_output;
#else
    if (x.data == nullptr) x = source();
    x.depth = rows;
#endif
    for (int64_t first = 0; first < padded; first += kPanel) {
      float* c = partial + first;
      multiply<true>({&x, 1, gradient + first, padded, fill ? kZeros : c, fill ? 0 : padded, c, padded, Finish::none,
                      nullptr, nullptr, 0},
                     inputs(), smaller(kPanel, padded - first));
    }
  }

  void input_gradient(const float* gradient) const {
    const MlpPlanLayer& layer = call.layer;
    Source a = {gradient, layer.padded, outputs()};
#if VN_HALF
    a = {workspace + call.scratch_output, layer.padded / 2, (outputs() + 1) / 2};
    narrow(gradient, layer.padded, outputs(), rows, workspace + call.scratch_output);
#endif
    const int64_t padded = padded_width(call.source);
    const bool direct = inputs() % (VN_HALF ? 2 * kGranule : kGranule) == 0 && call.bfloat16 == VN_HALF;
    float* out = direct ? static_cast<float*>(call.grad_x) + begin * inputs() / (VN_HALF ? 2 : 1) : nullptr;
    float* staged = workspace + call.input_gradient;
    for (int64_t first = 0; first < padded; first += kPanel) {
      const int64_t columns = smaller(kPanel, padded - first);
      float* c = !direct ? staged + first : VN_HALF ? nullptr : out + first;
      multiply<false>({&a, 1, workspace + call.source.packed + first * layer.packed_width, columns, kZeros, 0, c,
                       padded, Finish::none, nullptr, direct && VN_HALF ? out + first / 2 : nullptr, inputs() / 2},
                      rows, columns);
    }
    if (direct) return;
    for (int64_t row = 0; row < rows; ++row) {
      write_row(call, staged + row * padded, inputs(), call.grad_x, (begin + row) * inputs());
    }
  }
};

void pack_linear(const LinearCall& call, int64_t cell, float* workspace) {
  MlpPlanLayer layer = call.layer;
  layer.sources = &call.source;
  layer.source_count = 1;
  const int64_t size = layer.width * layer.depth;
  const float* weights = static_cast<const float*>(call.weight) + (call.bfloat16 ? 0 : cell * size);
  if (call.bfloat16) {
    widen_row(static_cast<const uint16_t*>(call.weight) + cell * size, size, workspace + call.wide);
    weights = workspace + call.wide;
  }
  pack_forward(weights, layer, workspace + layer.packed, workspace + call.scratch_input);
  float* bias = workspace + layer.bias;
  if (call.bias == nullptr) {
    for (int64_t o = 0; o < layer.padded; ++o) bias[o] = 0.0f;
  } else {
    read_row(call, call.bias, cell * layer.width, layer.width, layer.padded, bias);
  }
  if (call.grad_x != nullptr) pack_backward(weights, layer, call.source, workspace + call.source.packed);
}

void run_linear_forward(const LinearCall& call, int64_t begin, int64_t end, float* workspace) {
  for (int64_t row = begin; row < end; row += call.tile) {
    LinearTile{call, workspace, row, smaller(call.tile, end - row)}.forward();
  }
}

void run_linear_backward(const LinearCall& call, int64_t begin, int64_t end, float* workspace, float* partial) {
  for (int64_t row = begin; row < end; row += call.tile) {
    LinearTile{call, workspace, row, smaller(call.tile, end - row)}.backward(partial, row == begin);
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
