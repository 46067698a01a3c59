// Encodings of a tile's rows on CUDA, and the gradients to what was encoded. A thread has an entry, of a hash grid a
// level of a row, neighbouring lanes neighbouring rows of one level, whose entries often share sectors.
#pragma once

#include <type_traits>

#include "encoding/encode_math.h"
#include "encoding/hash_encode_device.h"
#include "encoding/spherical_harmonics_math.h"
#include "network/cuda/program_cuda_tile.h"

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
template <TableType kType>
__device__ __forceinline__ const typename HashElement<kType>::Type* hash_table(const ProgramTile& tile, int parameter) {
  return static_cast<const typename HashElement<kType>::Type*>(tile.call.parameters[parameter]) +
         tile.cell * tile.call.strides[parameter];
}

static __device__ __noinline__ void look_up(const ProgramTile& tile, const ProgramStep& step, const Rows& x,
                                            float* to) {
  const HashEncoding& grid = tile.call.grids[step.number];
  hash_with_table(grid.features, tile.call.parameter_types[step.parameter], [&](auto features, auto type) {
    constexpr int kFeatures = decltype(features)::value;
    constexpr TableType kType = decltype(type)::value;
    const auto* table = hash_table<kType>(tile, step.parameter);
#pragma unroll 1
    for (int i = threadIdx.x; i < tile.height * grid.count; i += kProgramThreads) {
      const int number = i / tile.height, row = i % tile.height;
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
      for (int f = 0; f < kFeatures; ++f) to[row * step.stride + number * kFeatures + f] = sums[f];
    }
  });
}

// Adds to the gradient of a table that of what was looked up, a value of a step, by atomic operations.
static __device__ __noinline__ void scatter_rows(const ProgramTile& tile, const ProgramStep& step,
                                                 const ProgramScatter& scatter) {
  const CudaProgram& call = tile.call;
  const HashEncoding& grid = call.grids[scatter.grid];
  float* const to = call.sums[scatter.sum] + tile.cell * call.strides[scatter.parameter];
  hash_with_features(grid.features, [&](auto features) {
    constexpr int kFeatures = decltype(features)::value;
#pragma unroll 1
    for (int i = threadIdx.x; i < tile.height * grid.count; i += kProgramThreads) {
      const int number = i / tile.height, row = i % tile.height;
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
static __device__ __noinline__ void look_up_gradient(const ProgramTile& tile, const ProgramStep& step, const Rows& x,
                                                     const Rows& g, float* to) {
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
        to[row * step.stride + axis] = slope == 0.0f ? 0.0f : slope * sums[axis];
      }
    }
  });
}

// A row a thread: the polynomials share their terms.
static __device__ __noinline__ void harmonics(const ProgramTile& tile, const ProgramStep& step, const Rows& x,
                                              const Rows* g, float* to) {
  const int row = threadIdx.x, degree = step.number;
  if (row >= tile.rows) return;
  float values[kMostHarmonics] = {}, found[3];
  if (g == nullptr) {
    spherical_harmonics_of(x.at(row, 0), x.at(row, 1), x.at(row, 2), degree, values);
#pragma unroll
    for (int c = 0; c < kMostHarmonics; ++c) {
      if (c < step.width) to[row * step.stride + c] = values[c];
    }
    return;
  }
#pragma unroll
  for (int c = 0; c < kMostHarmonics; ++c) {
    if (c < degree * degree) values[c] = g->at(row, c);
  }
  spherical_harmonics_gradient(x.at(row, 0), x.at(row, 1), x.at(row, 2), degree, values, found);
#pragma unroll
  for (int c = 0; c < 3; ++c) to[row * step.stride + c] = found[c];
}

// Sines and cosines of `features` columns of x in octaves; after x itself, or blurred by the variances beside it.
static __device__ __noinline__ void octaves(const ProgramTile& tile, const ProgramStep& step, int features,
                                            const Rows& x, float* to) {
  const bool blurred = step.encoding == ProgramEncoding::integrated;
  const int before = blurred ? 0 : features;
  for_each_entry(tile.rows, step.width, [&](int row, int column) {
    float value = x.at(row, column % features);
    if (column >= before) {
      const int part = (column - before) / features, feature = (column - before) % features;
      const float scale = octave_scale(part / 2);
      value = sine_of_octave(x.at(row, feature) * scale, part % 2 == 0 ? 0.0f : 0.5f);
      if (blurred) value *= octave_blur(scale, x.at(row, features + feature));
    }
    to[row * step.stride + column] = value;
  });
}

// The gradient to them from g, with what was encoded: the derivative of a sine is the cosine beside it.
static __device__ __noinline__ void octaves_gradient(const ProgramTile& tile, const ProgramStep& step, int features,
                                                     const Rows& g, const Rows& encoded, float* to) {
  const bool blurred = step.encoding == ProgramEncoding::integrated;
  const int before = blurred ? 0 : features;
  for_each_entry(tile.rows, features, [&](int row, int feature) {
    float sum = blurred ? 0.0f : g.at(row, feature), of_variance = 0.0f;
    for (int octave = 0; octave < step.depth; ++octave) {
      const int sine = before + 2 * octave * features + feature, cosine = sine + features;
      const float scale = octave_scale(octave);
      sum += scale * (g.at(row, sine) * encoded.at(row, cosine) - g.at(row, cosine) * encoded.at(row, sine));
      of_variance -= 0.5f * scale * scale *
                     (g.at(row, sine) * encoded.at(row, sine) + g.at(row, cosine) * encoded.at(row, cosine));
    }
    to[row * step.stride + feature] = sum;
    if (blurred) to[row * step.stride + features + feature] = of_variance;
  });
}

// A step that encodes. Operands are x or, for the gradient, x, g and what was encoded.
__device__ inline void encode_step(const ProgramTile& tile, const ProgramStep& step, const ProgramOperand* operands) {
  const Rows x = tile.operand(operands[0]), g = step.order > 0 ? tile.operand(operands[1]) : Rows{};
  float* const to = tile.slot(step.slot);
  if (step.encoding == ProgramEncoding::hash) {
    return step.order > 0 ? look_up_gradient(tile, step, x, g, to) : look_up(tile, step, x, to);
  }
  if (step.encoding == ProgramEncoding::spherical) {
    return harmonics(tile, step, x, step.order > 0 ? &g : nullptr, to);
  }
  const int features = operands[0].width / (step.encoding == ProgramEncoding::integrated ? 2 : 1);
  if (step.order == 0) return octaves(tile, step, features, x, to);
  octaves_gradient(tile, step, features, g, tile.operand(operands[2]), to);
}

}  // namespace voronerf
