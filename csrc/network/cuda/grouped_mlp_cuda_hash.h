// A hash grid inside a tile: positions looked up as operands, and their gradients.
//
// A lane takes a level of a row at a time, neighbouring lanes neighbouring rows of one level, whose entries often share
// sectors. With gradients the forward pass also keeps what it has found, 64 bytes a row at 8 levels of two features:
// to write and to read them is 128 bytes of memory, and to look up again 64 entries, each a sector of 32 bytes of the
// second-level cache. The gradient of the table is added up by atomic operations, in any order.
#pragma once

#include "encoding/hash_encode_device.h"
#include "network/cuda/grouped_mlp_cuda_tile.h"

namespace voronerf {

constexpr int kMlpHashFeatures = 8;  // of a level, at most

// run(features of a level, type of the table), as constants.
template <int kFeatures, typename Run>
__device__ __forceinline__ void mlp_hash_with_type(TableType type, const Run& run) {
  using Features = std::integral_constant<int, kFeatures>;
  if (type == TableType::float32) {
    run(Features(), std::integral_constant<TableType, TableType::float32>());
  } else if (type == TableType::bfloat16) {
    run(Features(), std::integral_constant<TableType, TableType::bfloat16>());
  } else {
    run(Features(), std::integral_constant<TableType, TableType::float16>());
  }
}
template <typename Run>
__device__ __forceinline__ void mlp_hash_with(const HashEncoding& grid, const Run& run) {
  switch (grid.features) {
    case 1:
      return mlp_hash_with_type<1>(grid.in.type, run);
    case 2:
      return mlp_hash_with_type<2>(grid.in.type, run);
    case 4:
      return mlp_hash_with_type<4>(grid.in.type, run);
    default:
      return mlp_hash_with_type<8>(grid.in.type, run);
  }
}

// Entries before those of a level in the table of a cell.
__device__ inline int64_t mlp_hash_first(const HashEncoding& grid, const GridLevel& level, int cell) {
  return (grid.in.tables > 1 ? cell * grid.in.entries : 0) + level.offset;
}

struct MlpHashAxes {
  HashAxis axes[3];
};
__device__ inline MlpHashAxes mlp_hash_axes(const HashEncoding& grid, const GridLevel& level, const float* raw) {
  MlpHashAxes found;
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    const float place = hash_place(raw[axis], grid.low[axis], grid.inverse[axis]).place;
    found.axes[axis] = hash_axis(place, level, grid.smooth);
  }
  return found;
}

// Looks a warp's rows up, into its region and where `encoded` is; rows past the end are zero.
template <typename Products, int kRows>
__device__ void mlp_hash_encode(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid, int cell,
                                typename Products::Element* region, int64_t first, int64_t end) {
  const MlpCudaInput& input = plan.positions;
  const int lane = threadIdx.x % 32;
  mlp_hash_with(grid, [&](auto features, auto type) {
    constexpr int kFeatures = decltype(features)::value;
    constexpr TableType kType = decltype(type)::value;
    const auto* table = static_cast<const typename HashElement<kType>::Type*>(grid.in.table);
#pragma unroll 1
    for (int i = lane; i < kRows * grid.count; i += 32) {
      const int number = i / kRows, row = i % kRows, column = number * kFeatures;
      const bool there = first + row < end;
      float sums[kFeatures] = {};
      if (there) {
        const GridLevel& level = grid.levels[number];
        const MlpHashAxes at = mlp_hash_axes(grid, level, mlp_positions(plan, data, first + row));
        const int64_t before = mlp_hash_first(grid, level, cell) * kFeatures;
        hash_corners<kFeatures>(at.axes, level, before, [&](int64_t entry, int x, int y, int z) {
          const float weight = hash_weight(at.axes, false, nullptr, x, y, z);
#pragma unroll
          for (int f = 0; f < kFeatures; ++f) sums[f] += weight * hash_element<kType>(table + entry + f);
        });
      }
      auto* to = region + input.value + row * input.stride + column;
      float* kept = there && data.encoded != nullptr ? data.encoded + (first + row) * input.padded + column : nullptr;
#pragma unroll
      for (int f = 0; f < kFeatures; ++f) {
        if (kept != nullptr) kept[f] = sums[f];
        if constexpr (kFeatures == 1) {
          Products::store_one(to, sums[0]);
        } else {
          if (f % 2 == 0) Products::store(to + f, sums[f], sums[f + 1]);
        }
      }
    }
  });
  const int rest = input.padded - input.width;
  for (int i = lane; i < kRows * rest; i += 32) {
    Products::store_one(region + input.value + i / rest * input.stride + input.width + i % rest, 0.0f);
  }
}

// Adds to the gradient of the table, from those of a warp's rows, which lie where their encoding was.
template <typename Products, int kRows>
__device__ void mlp_hash_table_backward(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid,
                                        int cell, const typename Products::Element* region, int64_t first,
                                        int64_t end) {
  const MlpCudaInput& input = plan.positions;
  for (int i = threadIdx.x % 32; i < kRows * grid.count; i += 32) {
    const int number = i / kRows, row = i % kRows, features = grid.features;
    if (first + row >= end) continue;
    const GridLevel& level = grid.levels[number];
    const MlpHashAxes at = mlp_hash_axes(grid, level, mlp_positions(plan, data, first + row));
    const auto* arriving = region + input.value + row * input.stride + number * features;
    float* to = data.grad_features + mlp_hash_first(grid, level, cell) * features;
    float given[kMlpHashFeatures];
#pragma unroll
    for (int f = 0; f < kMlpHashFeatures; ++f) given[f] = f < features ? Products::load(arriving + f) : 0.0f;
    hash_corners<1>(at.axes, level, 0, [&](int64_t entry, int x, int y, int z) {
      const float weight = hash_weight(at.axes, false, nullptr, x, y, z);
#pragma unroll
      for (int f = 0; f < kMlpHashFeatures; ++f) {
        if (f < features) atomicAdd(to + entry * features + f, weight * given[f]);
      }
    });
  }
}

// Gradients of a warp's positions likewise, a row a lane.
template <typename Products, int kRows>
__device__ void mlp_hash_positions_backward(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid,
                                            int cell, const typename Products::Element* region, int64_t first,
                                            int64_t end) {
  const MlpCudaInput& input = plan.positions;
  const int row = threadIdx.x % 32;
  if (row >= kRows || first + row >= end) return;
  const float* raw = mlp_positions(plan, data, first + row);
  float sums[3] = {};
  mlp_hash_with(grid, [&](auto features, auto type) {
    constexpr int kFeatures = decltype(features)::value;
    constexpr TableType kType = decltype(type)::value;
    const auto* table = static_cast<const typename HashElement<kType>::Type*>(grid.in.table);
#pragma unroll 1
    for (int number = 0; number < grid.count; ++number) {
      const GridLevel& level = grid.levels[number];
      const MlpHashAxes at = mlp_hash_axes(grid, level, raw);
      const auto* arriving = region + input.value + row * input.stride + number * kFeatures;
      const int64_t before = mlp_hash_first(grid, level, cell) * kFeatures;
      hash_corners<kFeatures>(at.axes, level, before, [&](int64_t entry, int x, int y, int z) {
        float product = 0.0f;
#pragma unroll
        for (int f = 0; f < kFeatures; ++f) {
          product += Products::load(arriving + f) * hash_element<kType>(table + entry + f);
        }
        const int corner[3] = {x, y, z};
#pragma unroll
        for (int axis = 0; axis < 3; ++axis) {
          sums[axis] += product * hash_weight_slope(at.axes, false, nullptr, axis, corner);
        }
      });
    }
  });
  float* result = data.grad_positions + mlp_source_row(data, first + row) * 3;
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    const float slope = hash_place(raw[axis], grid.low[axis], grid.inverse[axis]).slope;
    result[axis] = slope == 0.0f ? 0.0f : slope * sums[axis];
  }
}

}  // namespace voronerf
