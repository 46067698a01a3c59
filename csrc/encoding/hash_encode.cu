// The hash encoding on CUDA. A thread handles one point and a few levels. The y axis of the grid runs over groups of
// levels, so that the entries read at a time fit the L2 cache (Mueller et al. 2022, section 4, do this level by level).
// The levels of a thread have eight features together, so the thread writes a whole sector of 32 bytes, and reads one
// in the backward pass.
//
// The table's gradient is summed by atomic operations, in no fixed order. For the gradient of the positions, one thread
// per point sums over the levels.
#include "common/cuda_wrappers.h"
#include "encoding/hash_encode.h"
#include "encoding/hash_encode_device.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kSector = 8;  // features of a thread's levels, 32 bytes

// The corners around a point on one level.
struct Corners {
  HashAxis axes[3];
  float along[3];
  bool directed;
};

__device__ __forceinline__ void place_of(const HashEncoding& in, int64_t point, HashPlace (&places)[3]) {
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    places[axis] = hash_place(in.in.positions[3 * point + axis], in.low[axis], in.inverse[axis]);
  }
}

__device__ __forceinline__ Corners corners_of(const HashEncoding& in, int64_t point, const GridLevel& level,
                                              const HashPlace (&places)[3]) {
  Corners corners;
  corners.directed = in.in.direction != nullptr;
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    corners.axes[axis] = hash_axis(places[axis].place, level);
    corners.along[axis] = corners.directed ? places[axis].slope * in.in.direction[3 * point + axis] : 0.0f;
  }
  return corners;
}

// Returns the index, in the array of all tables, at which a level begins in the table of a point's cell; negative if
// the cell has no table.
template <int kFeatures>
__device__ __forceinline__ int64_t first_of(const HashEncoding& in, const GridLevel& level, int64_t point) {
  const int64_t table = in.in.cells == nullptr ? 0 : in.in.cells[point];
  if (table < 0 || table >= in.in.tables) return -1;
  return (table * in.in.entries + level.offset) * kFeatures;
}

template <int kFeatures, TableType kType>
__global__ void __launch_bounds__(kThreads, 4) hash_encode_kernel(HashEncoding in, float* __restrict__ out) {
  const int64_t point = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (point >= in.in.n) return;
  const auto* table = static_cast<const typename HashElement<kType>::Type*>(in.in.table);
  HashPlace places[3];
  place_of(in, point, places);
#pragma unroll 1
  for (int i = 0; i < kSector / kFeatures; ++i) {
    const int number = blockIdx.y * (kSector / kFeatures) + i;
    if (number >= in.count) return;
    const GridLevel& level = in.levels[number];
    const Corners at = corners_of(in, point, level, places);
    const int64_t first = first_of<kFeatures>(in, level, point);
    float sums[kFeatures] = {};
    if (first >= 0) {
      hash_corners<kFeatures>(at.axes, level, first, [&](int64_t entry, int x, int y, int z) {
        const float weight = hash_weight(at.axes, at.directed, at.along, x, y, z);
        float values[kFeatures];
        hash_load<kType>(table + entry, values);
#pragma unroll
        for (int f = 0; f < kFeatures; ++f) sums[f] += weight * values[f];
      });
    }
    hash_store(out + (point * in.count + number) * kFeatures, sums);
  }
}

template <int kFeatures>
__global__ void __launch_bounds__(kThreads, 4)
    hash_encode_table_backward_kernel(HashEncoding in, const float* __restrict__ gradient,
                                      float* __restrict__ of_table) {
  const int64_t point = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (point >= in.in.n) return;
  HashPlace places[3];
  place_of(in, point, places);
#pragma unroll 1
  for (int i = 0; i < kSector / kFeatures; ++i) {
    const int number = blockIdx.y * (kSector / kFeatures) + i;
    if (number >= in.count) return;
    const GridLevel& level = in.levels[number];
    const int64_t first = first_of<kFeatures>(in, level, point);
    if (first < 0) return;
    const Corners at = corners_of(in, point, level, places);
    float arriving[kFeatures];
    hash_load<TableType::float32>(gradient + (point * in.count + number) * kFeatures, arriving);
    hash_corners<kFeatures>(at.axes, level, first, [&](int64_t entry, int x, int y, int z) {
      const float weight = hash_weight(at.axes, at.directed, at.along, x, y, z);
      float added[kFeatures];
#pragma unroll
      for (int f = 0; f < kFeatures; ++f) added[f] = weight * arriving[f];
      hash_add(of_table + entry, added);
    });
  }
}

template <int kFeatures, TableType kType>
__global__ void __launch_bounds__(kThreads, 3)
    hash_encode_positions_backward_kernel(HashEncoding in, const float* __restrict__ gradient,
                                          float* __restrict__ of_positions) {
  const int64_t point = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (point >= in.in.n) return;
  const auto* table = static_cast<const typename HashElement<kType>::Type*>(in.in.table);
  HashPlace places[3];
  place_of(in, point, places);
  float sums[3] = {};
  for (int number = 0; number < in.count; ++number) {
    const GridLevel& level = in.levels[number];
    const Corners at = corners_of(in, point, level, places);
    const int64_t first = first_of<kFeatures>(in, level, point);
    if (first < 0) break;
    float arriving[kFeatures];
    hash_load<TableType::float32>(gradient + (point * in.count + number) * kFeatures, arriving);
    hash_corners<kFeatures>(at.axes, level, first, [&](int64_t entry, int x, int y, int z) {
      float product = 0.0f, values[kFeatures];
      hash_load<kType>(table + entry, values);
#pragma unroll
      for (int f = 0; f < kFeatures; ++f) product += arriving[f] * values[f];
      const int corner[3] = {x, y, z};
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
        sums[axis] += product * hash_weight_slope(at.axes, at.directed, at.along, axis, corner);
      }
    });
  }
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    const float slope = places[axis].slope;
    of_positions[3 * point + axis] = slope == 0.0f ? 0.0f : slope * sums[axis];
  }
}

template <int kFeatures>
struct Width {
  static constexpr int value = kFeatures;
};
template <TableType kType>
struct Kind {
  static constexpr TableType value = kType;
};

template <typename Run>
void for_width(int features, const Run& run) {
  switch (features) {
    case 1:
      return run(Width<1>{});
    case 2:
      return run(Width<2>{});
    case 4:
      return run(Width<4>{});
    default:
      return run(Width<8>{});
  }
}

template <typename Run>
void for_table(const HashEncoding& in, const Run& run) {
  for_width(in.features, [&](auto width) {
    switch (in.in.type) {
      case TableType::float32:
        return run(width, Kind<TableType::float32>{});
      case TableType::bfloat16:
        return run(width, Kind<TableType::bfloat16>{});
      default:
        return run(width, Kind<TableType::float16>{});
    }
  });
}

unsigned blocks_of(int64_t n) { return static_cast<unsigned>(ceil_div<int64_t>(n, kThreads)); }

dim3 blocks_of(const HashEncoding& in) {
  return dim3(blocks_of(in.in.n), static_cast<unsigned>(ceil_div(in.count * in.features, kSector)));
}

}  // namespace

void hash_encode_cuda(const HashInputs& in, const HashGrid& grid, float* out, void* stream) {
  if (in.n == 0) return;
  VN_CHECK(reinterpret_cast<std::uintptr_t>(in.table) % 16 == 0,
           "hash_encode: the table must begin at a multiple of 16 bytes");
  const HashEncoding call = hash_encoding(in, grid);
  const dim3 blocks = blocks_of(call);
  for_table(call, [&](auto features, auto type) {
    const auto kernel = hash_encode_kernel<decltype(features)::value, decltype(type)::value>;
    VN_LAUNCH(kernel, blocks, kThreads, 0, stream, call, out);
  });
}

void hash_encode_backward_cuda(const HashInputs& in, const HashGrid& grid, const float* gradient, float* of_table,
                               float* of_positions, void* stream) {
  VN_CHECK(reinterpret_cast<std::uintptr_t>(in.table) % 16 == 0,
           "hash_encode: the table must begin at a multiple of 16 bytes");
  VN_CHECK(reinterpret_cast<std::uintptr_t>(gradient) % 16 == 0,
           "hash_encode: the gradient must begin at a multiple of 16 bytes");
  const HashEncoding call = hash_encoding(in, grid);
  if (of_table != nullptr) {
    const size_t bytes = sizeof(float) * static_cast<size_t>(in.tables * in.entries * grid.features);
    VN_CUDA_CHECK(cudaMemsetAsync(of_table, 0, bytes, static_cast<cudaStream_t>(stream)));
  }
  if (in.n == 0) return;
  const dim3 blocks = blocks_of(call);
  if (of_table != nullptr) {
    for_width(call.features, [&](auto features) {
      const auto kernel = hash_encode_table_backward_kernel<decltype(features)::value>;
      VN_LAUNCH(kernel, blocks, kThreads, 0, stream, call, gradient, of_table);
    });
  }
  if (of_positions != nullptr) {
    for_table(call, [&](auto features, auto type) {
      const auto kernel = hash_encode_positions_backward_kernel<decltype(features)::value, decltype(type)::value>;
      VN_LAUNCH(kernel, blocks_of(in.n), kThreads, 0, stream, call, gradient, of_positions);
    });
  }
}

}  // namespace voronerf
