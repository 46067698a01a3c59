// A hash grid inside a tile: positions looked up as operands, and their gradients.
//
// A lane takes a level of a row at a time, neighbouring lanes neighbouring rows of one level, whose entries often share
// sectors. With gradients the forward pass also keeps what it has found, 64 bytes a row at 8 levels of two features,
// which leave the tile row by row. To write and to read them is 128 bytes of memory, and to look up again 64 entries,
// each a sector of 32 bytes of the second-level cache. The gradient of the table is added up by atomic operations, in
// any order.
#pragma once

#include "encoding/hash_encode_device.h"
#include "network/cuda/grouped_mlp_cuda_tile.h"

namespace voronerf {

// run(features of a level), as a constant.
template <typename Run>
__device__ __forceinline__ void mlp_hash_with_features(const HashEncoding& grid, const Run& run) {
  switch (grid.features) {
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

// run(features of a level, type of the table), as constants.
template <typename Run>
__device__ __forceinline__ void mlp_hash_with(const HashEncoding& grid, const Run& run) {
  mlp_hash_with_features(grid, [&](auto features) {
    if (grid.in.type == TableType::float32) {
      run(features, std::integral_constant<TableType, TableType::float32>());
    } else if (grid.in.type == TableType::bfloat16) {
      run(features, std::integral_constant<TableType, TableType::bfloat16>());
    } else {
      run(features, std::integral_constant<TableType, TableType::float16>());
    }
  });
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

// Of a warp's rows those before the end.
__device__ inline int rows_until(int64_t first, int64_t end, int rows) {
  return end - first < rows ? static_cast<int>(end - first) : rows;
}

// visit(row, column) for every four columns of some rows of what is hashed, neighbouring lanes neighbouring columns.
template <typename Visit>
__device__ __forceinline__ void mlp_hash_each_four(const MlpCudaInput& input, int rows, const Visit& visit) {
  const int fours = input.padded / 4;
  for (int i = threadIdx.x % 32; i < rows * fours; i += 32) visit(i / fours, 4 * (i % fours));
}

// Looks a warp's rows up, into its region and, as they are rounded there, where `encoded` is; rows past the end are
// zero.
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
          float found[kFeatures];
          hash_load<kType>(table + entry, found);
#pragma unroll
          for (int f = 0; f < kFeatures; ++f) sums[f] += weight * found[f];
        });
      }
      auto* to = region + input.value + row * input.stride + column;
#pragma unroll
      for (int f = 0; f < kFeatures; ++f) {
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
  if (data.encoded == nullptr) return;
  __syncwarp();
  mlp_hash_each_four(input, rows_until(first, end, kRows), [&](int row, int column) {
    const auto* from = region + input.value + row * input.stride + column;
    const float4 four =
        make_float4(Products::load(from), Products::load(from + 1), Products::load(from + 2), Products::load(from + 3));
    *reinterpret_cast<float4*>(data.encoded + (first + row) * input.padded + column) = four;
  });
}

// Takes what the forward pass kept back into a warp's region.
template <typename Products, int kRows>
__device__ void mlp_hash_again(const MlpCudaInput& input, const MlpCudaData& data, typename Products::Element* region,
                               int64_t first, int64_t end) {
  const int rows = rows_until(first, end, kRows);
  mlp_hash_each_four(input, kRows, [&](int row, int column) {
    float4 four = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    if (row < rows) four = *reinterpret_cast<const float4*>(data.encoded + (first + row) * input.padded + column);
    auto* to = region + input.value + row * input.stride + column;
    Products::store(to, four.x, four.y);
    Products::store(to + 2, four.z, four.w);
  });
}

// Adds to the gradient of the table, from those of a warp's rows, which lie where their encoding was.
template <typename Products, int kRows>
__device__ void mlp_hash_table_backward(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid,
                                        int cell, const typename Products::Element* region, int64_t first,
                                        int64_t end) {
  const MlpCudaInput& input = plan.positions;
  mlp_hash_with_features(grid, [&](auto features) {
    constexpr int kFeatures = decltype(features)::value;
#pragma unroll 1
    for (int i = threadIdx.x % 32; i < kRows * grid.count; i += 32) {
      const int number = i / kRows, row = i % kRows;
      if (first + row >= end) continue;
      const GridLevel& level = grid.levels[number];
      const MlpHashAxes at = mlp_hash_axes(grid, level, mlp_positions(plan, data, first + row));
      const auto* arriving = region + input.value + row * input.stride + number * kFeatures;
      float given[kFeatures];
#pragma unroll
      for (int f = 0; f < kFeatures; ++f) given[f] = Products::load(arriving + f);
      const int64_t before = mlp_hash_first(grid, level, cell) * kFeatures;
      hash_corners<kFeatures>(at.axes, level, before, [&](int64_t entry, int x, int y, int z) {
        const float weight = hash_weight(at.axes, false, nullptr, x, y, z);
        float added[kFeatures];
#pragma unroll
        for (int f = 0; f < kFeatures; ++f) added[f] = weight * given[f];
        hash_add(data.grad_features + entry, added);
      });
    }
  });
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
        float product = 0.0f, found[kFeatures];
        hash_load<kType>(table + entry, found);
#pragma unroll
        for (int f = 0; f < kFeatures; ++f) product += Products::load(arriving + f) * found[f];
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
