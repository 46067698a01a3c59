// Encodings of a tile's rows on CUDA, and the gradients to what was encoded. A thread has an entry, of a hash grid a
// level of a row, neighbouring lanes neighbouring rows of one level, whose entries often share sectors.
#pragma once

#include <type_traits>

#include "encoding/encode_math.h"
#include "encoding/hash_encode_device.h"
#include "network/cuda/program_cuda_tile.h"
#include "network/cuda/words_device.h"
// behind the words
#include "encoding/encodings.h"

namespace voronerf {

// run(features of a level), as a constant.
template <typename Run>
__device__ __forceinline__ void hash_with_features(int features, const Run& run) {
  switch (features) {
    case 1:
      return run(std::integral_constant<int, 1>());
    case 2:
      return run(std::integral_constant<int, 2>());
    case 4:
      return run(std::integral_constant<int, 4>());
    default:
      return run(std::integral_constant<int, 8>());
  }
}

// run(features of a level, a table of its type), as constants.
template <typename Run>
__device__ __forceinline__ void hash_with_table(int features, int type, const Run& run) {
  hash_with_features(features, [&](auto count) {
    switch (static_cast<TableType>(type)) {
      case TableType::float32:
        return run(count, std::integral_constant<TableType, TableType::float32>());
      case TableType::bfloat16:
        return run(count, std::integral_constant<TableType, TableType::bfloat16>());
      default:
        return run(count, std::integral_constant<TableType, TableType::float16>());
    }
  });
}

struct HashAxes {
  HashAxis axes[3];
};
// point(axis) -> coordinate.
template <typename Point>
__device__ __forceinline__ HashAxes hash_axes(const HashEncoding& grid, const GridLevel& level, const Point& point) {
  HashAxes found;
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    found.axes[axis] = hash_axis(hash_place(point(axis), grid.low[axis], grid.inverse[axis]).place, level, grid.smooth);
  }
  return found;
}

// The table of a cell.
template <TableType kType, typename Tile>
__device__ __forceinline__ const typename HashElement<kType>::Type* hash_table(const Tile& tile, int parameter) {
  return static_cast<const typename HashElement<kType>::Type*>(tile.call.parameters[parameter]) +
         tile.cell * tile.call.strides[parameter];
}

template <typename Tile>
__device__ __noinline__ void look_up(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands) {
  const Rows x = tile.value(operands[0]);
  const Target to = tile.target(step);
  const HashEncoding& grid = tile.call.grids[step.number];
  const int shift = 31 - __clz(tile.height);
  hash_with_table(grid.features, tile.call.parameter_types[step.parameter], [&](auto features, auto type) {
    constexpr int kFeatures = decltype(features)::value;
    constexpr TableType kType = decltype(type)::value;
    const auto* table = hash_table<kType>(tile, step.parameter);
#pragma unroll 1
    for (int i = threadIdx.x; i < tile.height * grid.count; i += kProgramThreads) {
      const int number = i >> shift, row = i & (tile.height - 1);
      if (row >= tile.rows) continue;
      const GridLevel& level = grid.levels[number];
      const HashAxes at = hash_axes(grid, level, [&](int axis) { return x.at(row, axis); });
      float sums[kFeatures] = {};
      hash_corners<kFeatures>(at.axes, level, level.offset * kFeatures, [&](int64_t entry, int a, int b, int c) {
        const float weight = hash_weight(at.axes, false, nullptr, a, b, c);
        float found[kFeatures];
        hash_load<kType>(table + entry, found);
#pragma unroll
        for (int f = 0; f < kFeatures; ++f) sums[f] += weight * found[f];
      });
#pragma unroll
      for (int f = 0; f < kFeatures; ++f) to.put(row, number * kFeatures + f, sums[f]);
    }
  });
}

// Adds to the gradient of a table that of what was looked up, a value of a step, by atomic operations.
template <typename Tile>
__device__ __noinline__ void scatter_rows(const Tile& tile, const ProgramStep& step, const ProgramScatter& scatter) {
  const CudaProgram& call = tile.call;
  const HashEncoding& grid = call.grids[scatter.grid];
  float* const to = call.sums[scatter.sum] + tile.cell * call.strides[scatter.parameter];
  const int shift = 31 - __clz(tile.height);
  hash_with_features(grid.features, [&](auto features) {
    constexpr int kFeatures = decltype(features)::value;
#pragma unroll 1
    for (int i = threadIdx.x; i < tile.height * grid.count; i += kProgramThreads) {
      const int number = i >> shift, row = i & (tile.height - 1);
      if (row >= tile.rows) continue;
      const int64_t source = source_row(call.rows, tile.begin + row);
      const GridLevel& level = grid.levels[number];
      const HashAxes at =
          hash_axes(grid, level, [&](int axis) { return load_input(call, scatter.input, 3, source, axis); });
      const float* given = tile.slot(step.slot) + row * step.stride + number * kFeatures;
      hash_corners<kFeatures>(at.axes, level, level.offset * kFeatures, [&](int64_t entry, int x, int y, int z) {
        const float weight = hash_weight(at.axes, false, nullptr, x, y, z);
        float added[kFeatures];
#pragma unroll
        for (int f = 0; f < kFeatures; ++f) added[f] = weight * given[f];
        hash_add(to + entry, added);
      });
    }
  });
}

// Eight lanes share a row and its levels.
template <typename Tile>
__device__ __noinline__ void look_up_gradient(const Tile& tile, const ProgramStep& step,
                                              const ProgramOperand* operands) {
  const Rows x = tile.value(operands[0]), g = tile.value(operands[1]);
  const Target to = tile.target(step);
  const HashEncoding& grid = tile.call.grids[step.number];
  const int part = threadIdx.x % 8;
  hash_with_table(grid.features, tile.call.parameter_types[step.parameter], [&](auto features, auto type) {
    constexpr int kFeatures = decltype(features)::value;
    constexpr TableType kType = decltype(type)::value;
    const auto* table = hash_table<kType>(tile, step.parameter);
#pragma unroll 1
    for (int first = 0; first < tile.rows; first += kProgramThreads / 8) {
      const int row = first + threadIdx.x / 8;
      float sums[3] = {};
#pragma unroll 1
      for (int number = part; row < tile.rows && number < grid.count; number += 8) {
        const GridLevel& level = grid.levels[number];
        const HashAxes at = hash_axes(grid, level, [&](int axis) { return x.at(row, axis); });
        hash_corners<kFeatures>(at.axes, level, level.offset * kFeatures, [&](int64_t entry, int a, int b, int c) {
          float product = 0.0f, found[kFeatures];
          hash_load<kType>(table + entry, found);
#pragma unroll
          for (int f = 0; f < kFeatures; ++f) product += g.at(row, number * kFeatures + f) * found[f];
          const int corner[3] = {a, b, c};
#pragma unroll
          for (int axis = 0; axis < 3; ++axis) {
            sums[axis] += product * hash_weight_slope(at.axes, false, nullptr, axis, corner);
          }
        });
      }
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
#pragma unroll
        for (int other = 4; other > 0; other /= 2) sums[axis] += __shfl_xor_sync(kAllLanes, sums[axis], other);
        if (part != axis || row >= tile.rows) continue;
        const float slope = hash_place(x.at(row, axis), grid.low[axis], grid.inverse[axis]).slope;
        to.put(row, axis, slope == 0.0f ? 0.0f : slope * sums[axis]);
      }
    }
  });
}

// The formula of a row, by a thread for each: what its columns share is computed once.
template <typename Formula>
struct ByRow {
  template <typename Tile>
  static __device__ __noinline__ void run(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands) {
    const Rows x = tile.value(operands[0]);
    const Target to = tile.target(step);
    const int row = threadIdx.x, raw = operands[0].width;
    if (row >= tile.rows) return;
    const auto of = [&](int column) { return x.at(row, column); };
    const auto put = [&](int column, float value) { to.put(row, column, value); };
    if (step.order == 0) return Formula::values(of, raw, step.depth, put);
    const Rows g = tile.value(operands[1]);
    Formula::gradient(of, raw, step.depth, [&](int column) { return g.at(row, column); }, put);
  }
};

// By the hardware's own functions, whose error is 2^-21 near 0.
__device__ __forceinline__ void fast_sine_and_cosine(float angle, float& sine, float& cosine) {
#ifndef VN_EMULATE
  if (fabsf(angle) <= kLargestDeviceAngle) {
    const float turns = rintf(angle * 0.159154943f);
    const float r = fmaf(turns, 1.74845553e-7f, fmaf(turns, -6.28318548f, angle));
    sine = __sinf(r), cosine = __cosf(r);
    return;
  }
#endif
  sine = sine_of_octave(angle, 0.0f), cosine = sine_of_octave(angle, 0.5f);
}

// Sines and cosines of `features` columns of x in octaves; after x itself, or blurred by the variances beside it. A
// thread has a sine and its cosine. For 16-bit products the hardware's do.
template <bool kFast, typename Tile>
__device__ __forceinline__ void octave_pairs(const Tile& tile, int octaves, int features, Rows x, Target to,
                                             bool blurred) {
  const int before = blurred ? 0 : features;
  // A product in place of a division, which is right for what is below 2^32 / features.
  const uint32_t inverse = 0xffffffffu / static_cast<uint32_t>(features) + 1u;
  for_each_entry(tile.rows, features * octaves, [&](int row, int i) {
    const int octave = features == 1 ? i : static_cast<int>(uint64_t{static_cast<uint32_t>(i)} * inverse >> 32);
    const int feature = i - octave * features, column = before + i + octave * features;
    const float scale = octave_scale(octave), angle = x.at(row, feature) * scale;
    float sine, cosine;
    if constexpr (kFast) {
      fast_sine_and_cosine(angle, sine, cosine);
    } else {
      sine = sine_of_octave(angle, 0.0f), cosine = sine_of_octave(angle, 0.5f);
    }
    if (blurred) {
      const float blur = octave_blur(scale, x.at(row, features + feature));
      sine *= blur, cosine *= blur;
    }
    to.put(row, column, sine);
    to.put(row, column + features, cosine);
  });
}
template <typename Tile>
__device__ __noinline__ void octaves(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands,
                                     int features, bool blurred) {
  const Rows x = tile.value(operands[0]);
  const Target to = tile.target(step);
  if (!blurred) {
    for_each_entry(tile.rows, features, [&](int row, int column) { to.put(row, column, x.at(row, column)); });
  }
  if (tile.halves) {
    octave_pairs<true>(tile, step.depth, features, x, to, blurred);
  } else {
    octave_pairs<false>(tile, step.depth, features, x, to, blurred);
  }
}

// The gradient to them from g, with what was encoded: the derivative of a sine is the cosine beside it.
template <typename Tile>
__device__ __noinline__ void octaves_gradient(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands,
                                              int features, bool blurred) {
  const Rows g = tile.value(operands[1]), encoded = tile.value(operands[2]);
  const Target to = tile.target(step);
  const int octaves = step.depth;
  const int before = blurred ? 0 : features;
  for_each_entry(tile.rows, features, [&](int row, int feature) {
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
    const int features = operands[0].width / (kBlurred ? 2 : 1);
    if (step.order == 0) return octaves(tile, step, operands, features, kBlurred);
    octaves_gradient(tile, step, operands, features, kBlurred);
  }
};

// A step that encodes. Operands are x or, for the gradient, x, g and what was encoded.
template <typename Tile>
__device__ __forceinline__ void encode_step(const Tile& tile, const ProgramStep& step, const ProgramOperand* operands) {
  using namespace device;  // the formulas
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
