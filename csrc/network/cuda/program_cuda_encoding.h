// Encodings of a team's rows on CUDA, and the gradients with respect to their inputs. A lane computes one entry or, for
// a hash grid, one level of a row. Neighbouring lanes have neighbouring rows of the same level, whose table entries
// often share sectors.
#pragma once

#include <type_traits>

#include "encoding/encode_math.h"
#include "encoding/hash_encode_device.h"
#include "network/cuda/program_cuda_tile.h"
#include "network/cuda/words_device.h"
// requires words_device.h
#include "encoding/encodings.h"

namespace voronerf {

// The features of an entry that are loaded at once. Calls run(count) with a compile-time constant; entries of eight
// features are two pieces.
template <typename Run>
__device__ __forceinline__ void hash_with_piece(int features, const Run& run) {
  switch (features) {
    case 1:
      return run(std::integral_constant<int, 1>());
    case 2:
      return run(std::integral_constant<int, 2>());
    default:
      return run(std::integral_constant<int, 4>());
  }
}

// A point in the box of a grid, and its corners on a level.
struct HashPoint {
  float places[3];
};
struct HashCell {
  HashAxis axes[3];
  uint32_t entries[8];  // of the corners
};
// point(axis) returns a coordinate.
template <typename Point>
__device__ __forceinline__ HashPoint hash_point(const HashEncoding& grid, const Point& point) {
  HashPoint result;
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    result.places[axis] = hash_place(point(axis), grid.low[axis], grid.inverse[axis]).place;
  }
  return result;
}
__device__ __forceinline__ HashCell hash_cell(const HashPoint& point, const GridLevel& level) {
  HashCell result;
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) result.axes[axis] = hash_axis(point.places[axis], level);
  for_each_corner([&](int corner, int x, int y, int z) {
    const HashAxis* const axes = result.axes;
    result.entries[corner] = hash_entry(level, axes[0].corner + x, axes[1].corner + y, axes[2].corner + z);
  });
  return result;
}

// Loads the features from `first` on of a cell's corners, from the table of the tile's cell. The code is separate for
// each type of table only here.
template <int kPiece, typename Tile>
__device__ __forceinline__ void hash_values(float (&values)[8][kPiece], const Tile& tile, int parameter,
                                            const HashCell& cell, const GridLevel& level, int features, int first) {
  const CudaProgram& call = tile.call;
  with_type(call.parameter_types[parameter], [&](auto type) {
    constexpr TableType kType = decltype(type)::value;
    const auto* const from = static_cast<const InMemory<kType>*>(call.parameters[parameter]) +
                             tile.cell() * call.strides[parameter] + level.offset * features + first;
    for_each_corner([&](int corner, int, int, int) {
      hash_load<kType>(from + cell.entries[corner] * static_cast<uint32_t>(features), values[corner]);
    });
  });
}

template <typename Tile>
__device__ __noinline__ void look_up(Tile tile, const ProgramStep& step, const ProgramOperand* operands) {
  const Operand x = tile.value(operands[0]);
  const auto to = tile.target(step);
  const HashEncoding& grid = tile.call.grids[step.number];
  const int row = Tile::worker() % Tile::kRows, features = grid.features, parameter = step.parameter;
  if (row >= tile.rows()) return;
  const HashPoint point = hash_point(grid, [&](int axis) { return x.at(row, axis); });
  hash_with_piece(features, [&](auto piece) {
    constexpr int kPiece = decltype(piece)::value;
#pragma unroll 1
    for (int number = Tile::worker() / Tile::kRows; number < grid.count; number += Tile::kWorkers / Tile::kRows) {
      const GridLevel& level = grid.levels[number];
      const HashCell cell = hash_cell(point, level);
#pragma unroll 1
      for (int first = 0; first < features; first += kPiece) {
        float values[8][kPiece], sums[kPiece] = {};
        hash_values(values, tile, parameter, cell, level, features, first);
        for_each_corner([&](int corner, int a, int b, int c) {
          const float weight = hash_weight(cell.axes, false, nullptr, a, b, c);
#pragma unroll
          for (int f = 0; f < kPiece; ++f) sums[f] += weight * values[corner][f];
        });
#pragma unroll
        for (int f = 0; f < kPiece; ++f) to.put(row, number * features + first + f, sums[f]);
      }
    }
  });
}

// Adds the gradient of a look-up, which is the value of a step, to the gradient of the table by atomic operations.
template <typename Tile>
__device__ __noinline__ void scatter_rows(Tile tile, const ProgramStep& step, const ProgramScatter& scatter) {
  const CudaProgram& call = tile.call;
  const HashEncoding& grid = call.grids[scatter.grid];
  const int row = Tile::worker() % Tile::kRows, features = grid.features;
  if (row >= tile.rows()) return;
  const InputRow from = input_row(call, scatter.input, 3, source_row(call.rows, tile.begin() + row));
  const HashPoint point = hash_point(grid, [&](int axis) { return from.column(axis); });
  float* const to = call.sums[scatter.sum] + tile.cell() * call.strides[scatter.parameter];
  const float* const gradients = tile.slot(step.slot) + row * step.stride;
  hash_with_piece(features, [&](auto piece) {
    constexpr int kPiece = decltype(piece)::value;
#pragma unroll 1
    for (int number = Tile::worker() / Tile::kRows; number < grid.count; number += Tile::kWorkers / Tile::kRows) {
      const GridLevel& level = grid.levels[number];
      const HashCell cell = hash_cell(point, level);
#pragma unroll 1
      for (int first = 0; first < features; first += kPiece) {
        const float* const gradient = gradients + number * features + first;
        float* const entries = to + level.offset * features + first;
        for_each_corner([&](int corner, int a, int b, int c) {
          const float weight = hash_weight(cell.axes, false, nullptr, a, b, c);
          float added[kPiece];
#pragma unroll
          for (int f = 0; f < kPiece; ++f) added[f] = weight * gradient[f];
          hash_add(entries + cell.entries[corner] * static_cast<uint32_t>(features), added);
        });
      }
    }
  });
}

// Computes the gradient of the points of a look-up. Eight lanes share the levels of a row.
template <typename Tile>
__device__ __noinline__ void look_up_gradient(Tile tile, const ProgramStep& step, const ProgramOperand* operands) {
  const Operand x = tile.value(operands[0]), g = tile.value(operands[1]);
  const auto to = tile.target(step);
  const HashEncoding& grid = tile.call.grids[step.number];
  const int worker = Tile::worker(), part = worker % 8, rows = tile.rows(), features = grid.features;
  hash_with_piece(features, [&](auto piece) {
    constexpr int kPiece = decltype(piece)::value;
#pragma unroll 1
    for (int top = 0; top < rows; top += Tile::kWorkers / 8) {
      const int row = top + worker / 8;
      float sums[3] = {};
#pragma unroll 1
      for (int number = part; row < rows && number < grid.count; number += 8) {
        const GridLevel& level = grid.levels[number];
        const HashCell cell = hash_cell(hash_point(grid, [&](int axis) { return x.at(row, axis); }), level);
        float products[8] = {};
#pragma unroll 1
        for (int first = 0; first < features; first += kPiece) {
          float values[8][kPiece];
          hash_values(values, tile, step.parameter, cell, level, features, first);
#pragma unroll
          for (int f = 0; f < kPiece; ++f) {
            const float by = g.at(row, number * features + first + f);
            for_each_corner([&](int corner, int, int, int) { products[corner] += by * values[corner][f]; });
          }
        }
        for_each_corner([&](int corner, int a, int b, int c) {
          const int at[3] = {a, b, c};
#pragma unroll
          for (int axis = 0; axis < 3; ++axis) {
            sums[axis] += products[corner] * hash_weight_slope(cell.axes, false, nullptr, axis, at);
          }
        });
      }
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
#pragma unroll
        for (int other = 4; other > 0; other /= 2) sums[axis] += __shfl_xor_sync(kAllLanes, sums[axis], other);
        if (part != axis || row >= rows) continue;
        const float slope = hash_place(x.at(row, axis), grid.low[axis], grid.inverse[axis]).slope;
        to.put(row, axis, slope == 0.0f ? 0.0f : slope * sums[axis]);
      }
    }
  });
}

// Evaluates a formula with one thread per row, so that common terms of a row's columns are computed once.
template <typename Formula>
struct ByRow {
  template <typename Tile>
  static __device__ __noinline__ void run(Tile tile, const ProgramStep& step, const ProgramOperand* operands) {
    const Operand x = tile.value(operands[0]);
    const auto to = tile.target(step);
    const int row = Tile::worker(), raw = operands[0].width;
    if (row >= tile.rows()) return;
    const auto of = [&](int column) { return x.at(row, column); };
    const auto put = [&](int column, float value) { to.put(row, column, value); };
    if (step.order == 0) return Formula::values(of, raw, step.depth, put);
    const Operand g = tile.value(operands[1]);
    Formula::gradient(of, raw, step.depth, [&](int column) { return g.at(row, column); }, put);
  }
};

// Returns sine and cosine by the hardware functions, with an error of 2^-21 near 0. The angle must not be large.
__device__ __forceinline__ float2 fast_sine_and_cosine(float angle) {
#ifdef VN_EMULATE
  return make_float2(sine_of_octave(angle, 0.0f), sine_of_octave(angle, 0.5f));
#else
  const float turns = rintf(angle * 0.159154943f);
  const float r = fmaf(turns, 1.74845553e-7f, fmaf(turns, -6.28318548f, angle));
  return make_float2(__sinf(r), __cosf(r));
#endif
}
// Returns the sine and cosine of an octave for large angles. It is not inlined, so that other code needs no registers
// for it.
__device__ __noinline__ float2 exact_sine_and_cosine(float value, int octave) {
  const float angle = value * octave_scale(octave);
  return make_float2(sine_of_octave(angle, 0.0f), sine_of_octave(angle, 0.5f));
}

// Computes sines and cosines of `features` columns of x in octaves. kBlurred: they are damped by the variances, which
// are the next `features` columns of x; otherwise the result begins with x itself. A thread computes a sine and its
// cosine.
template <bool kBlurred, typename Tile>
__device__ __forceinline__ void exact_octaves(const Tile& tile, int octaves, int features, const Operand& x,
                                              const Target<Tile::kBfloat16>& to) {
  if (!kBlurred) {
    for_each_entry<Tile>(tile.rows(), features, [&](int row, int column) { to.put(row, column, x.at(row, column)); });
  }
  // Division by multiplication, exact for dividends below 2^32 / features.
  const uint32_t inverse = 0xffffffffu / static_cast<uint32_t>(features) + 1u;
  for_each_entry<Tile>(tile.rows(), features * octaves, [&](int row, int i) {
    const int octave = features == 1 ? i : static_cast<int>(uint64_t{static_cast<uint32_t>(i)} * inverse >> 32);
    const int feature = i - octave * features, column = (kBlurred ? 0 : features) + i + octave * features;
    const float scale = octave_scale(octave), angle = x.at(row, feature) * scale;
    const float blur = kBlurred ? octave_blur(scale, x.at(row, features + feature)) : 1.0f;
    to.put(row, column, sine_of_octave(angle, 0.0f) * blur);
    to.put(row, column + features, sine_of_octave(angle, 0.5f) * blur);
  });
}
// Computes kCount octaves of a value from `first` on as words of 16-bit numbers: the first octave by the hardware
// functions, and the next ones by double-angle formulas, each of which doubles the error. Calls put(octave, sine,
// cosine) for each.
template <int kCount, bool kBfloat16, bool kBlurred, typename Put>
__device__ __forceinline__ void fast_words(uint32_t (&words)[kCount], float value, float variance, int first,
                                           const Put& put) {
  float2 pair = fast_sine_and_cosine(value * octave_scale(first));
  float blur = kBlurred ? octave_blur(octave_scale(first), variance) : 1.0f;
#pragma unroll
  for (int i = 0; i < kCount; ++i) {
    const float sine = pair.x * blur, cosine = pair.y * blur, twice = pair.x + pair.x;
    words[i] = pack_halves<kBfloat16>(sine, cosine);
    put(first + i, sine, cosine);
    pair = make_float2(twice * pair.y, fmaf(-twice, pair.x, 1.0f));
    if (kBlurred) blur *= blur * (blur * blur);  // the scale doubles, and the exponent has its square
  }
}
// Computes the octaves as 16-bit numbers in the order of WaveOrder, and as floats if kFloats. A thread computes all
// octaves of a feature of a row.
template <bool kBlurred, bool kFloats, typename Tile>
__device__ __forceinline__ void fast_octaves(const Tile& tile, int octaves, int features, const Operand& x,
                                             const Target<Tile::kBfloat16>& to) {
  const WaveOrder order{octaves, features, !kBlurred};
  const float largest = kLargestDeviceAngle * octave_scale(1 - octaves);
  const int row = Tile::worker() % Tile::kRows, last = octaves / 4 * 4;
  if (row >= tile.rows()) return;
  auto* const words = reinterpret_cast<uint32_t*>(to.halves + row * to.halves_stride);
  float* const floats = to.floats + row * to.stride;
#pragma unroll 1
  for (int feature = Tile::worker() / Tile::kRows; feature < features; feature += Tile::kWorkers / Tile::kRows) {
    const float value = x.at(row, feature), variance = kBlurred ? x.at(row, features + feature) : 0.0f;
    const auto put = [&](int octave, float sine, float cosine) {
      float* const at = floats + (2 * octave + order.raw) * features + feature;
      if (kFloats) at[0] = sine, at[features] = cosine;
    };
    if (!kBlurred) {
      const int place = wave_place(order, feature);
      to.put_half(row, place, value);
      if (feature == features - 1 && place % 2 == 0) to.put_half(row, place + 1, 0.0f);
      if (kFloats) floats[feature] = value;
    }
    if (!(fabsf(value) <= largest)) {  // too large, or NaN
#pragma unroll 1
      for (int octave = 0; octave < octaves; ++octave) {
        const float2 pair = exact_sine_and_cosine(value, octave);
        const float blur = kBlurred ? octave_blur(octave_scale(octave), variance) : 1.0f;
        const int place = wave_place(order, (2 * octave + order.raw) * features + feature);
        words[place / 2] = pack_halves<Tile::kBfloat16>(pair.x * blur, pair.y * blur);
        put(octave, pair.x * blur, pair.y * blur);
      }
      continue;
    }
    uint32_t* at = words + 4 * feature;
#pragma unroll 2
    for (int first = 0; first < last; first += 4, at += 4 * features) {
      uint32_t four[4];
      fast_words<4, Tile::kBfloat16, kBlurred>(four, value, variance, first, put);
      *reinterpret_cast<uint4*>(at) = uint4{four[0], four[1], four[2], four[3]};
    }
    at -= 2 * feature;
    if (octaves % 4 >= 2) {
      uint32_t two[2];
      fast_words<2, Tile::kBfloat16, kBlurred>(two, value, variance, last, put);
      *reinterpret_cast<uint2*>(at) = uint2{two[0], two[1]};
      at += 2 * features;
    }
    if (octaves % 2 == 1) {
      uint32_t one[1];
      fast_words<1, Tile::kBfloat16, kBlurred>(one, value, variance, octaves - 1, put);
      at[-feature] = one[0];
    }
  }
}
// Runs an encoding by octaves.
template <typename Tile>
__device__ __noinline__ void waves_step(Tile tile, int number) {
  const CudaStep step = load_step(tile.call.steps + number);
  const Operand x{tile.slot(step.x.slot) + step.x.start, step.x.stride, false};
  const auto to = tile.target(step);
  const int octaves = step.depth;
  if constexpr (Tile::kHalves) {  // 16-bit numbers have their own order
    if (to.has_halves) {
      if (step.is(kDamped) && to.has_floats) return fast_octaves<true, true>(tile, octaves, step.x.columns / 2, x, to);
      if (step.is(kDamped)) return fast_octaves<true, false>(tile, octaves, step.x.columns / 2, x, to);
      if (to.has_floats) return fast_octaves<false, true>(tile, octaves, step.x.columns, x, to);
      return fast_octaves<false, false>(tile, octaves, step.x.columns, x, to);
    }
  }
  if (step.is(kDamped)) return exact_octaves<true>(tile, octaves, step.x.columns / 2, x, to);
  exact_octaves<false>(tile, octaves, step.x.columns, x, to);
}

// Computes the gradient with respect to the encoded columns of x, from the encoding and from the gradient g with
// respect to it. The derivative of a sine is the cosine in the neighbouring column.
template <typename Tile>
__device__ __noinline__ void octaves_gradient(Tile tile, const ProgramStep& step, const ProgramOperand* operands,
                                              int features, bool blurred) {
  const Operand g = tile.value(operands[1]), encoded = tile.value(operands[2]);
  const auto to = tile.target(step);
  const int octaves = step.depth;
  const int before = blurred ? 0 : features;
  for_each_entry<Tile>(tile.rows(), features, [&](int row, int feature) {
    float sum = blurred ? 0.0f : g.at(row, feature), of_variance = 0.0f;
    for (int octave = 0; octave < octaves; ++octave) {
      const int sine = before + 2 * octave * features + feature, cosine = sine + features;
      const float scale = octave_scale(octave);
      sum += scale * (g.at(row, sine) * encoded.at(row, cosine) - g.at(row, cosine) * encoded.at(row, sine));
      of_variance -= 0.5f * scale * scale *
                     (g.at(row, sine) * encoded.at(row, sine) + g.at(row, cosine) * encoded.at(row, cosine));
    }
    to.put(row, feature, sum);
    if (blurred) to.put(row, features + feature, of_variance);
  });
}

template <bool kBlurred>
struct Octaves {
  template <typename Tile>
  static __device__ __forceinline__ void run(const Tile& tile, const ProgramStep& step,
                                             const ProgramOperand* operands) {
    octaves_gradient(tile, step, operands, operands[0].width / (kBlurred ? 2 : 1), kBlurred);  // waves_step has values
  }
};

// Runs an encoding step. The operand is x. The gradient with respect to x has three operands: x, the gradient with
// respect to the encoding, and the encoding.
template <typename Tile>
__device__ __forceinline__ void encode_step(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands) {
  using namespace device;  // the formulas of encodings
  switch (step.encoding) {
#define VN_CASE(NAME, ...)    \
  case ProgramEncoding::NAME: \
    return __VA_ARGS__::run(tile, step, operands);
    VN_ENCODINGS(VN_CASE)
#undef VN_CASE
    case ProgramEncoding::hash:
      return step.order > 0 ? look_up_gradient(tile, step, operands) : look_up(tile, step, operands);
  }
}

}  // namespace voronerf
