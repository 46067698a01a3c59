// What the CUDA kernels share that look hash grids up: the numbers of a table, and the corners around a point.
#pragma once

#include "common/cuda_wrappers.h"
#include "encoding/hash_encode_math.h"

namespace voronerf {

template <TableType kType>
struct HashElement {
  using Type = uint16_t;
};
template <>
struct HashElement<TableType::float32> {
  using Type = float;
};

template <TableType kType>
__device__ __forceinline__ float hash_element(const typename HashElement<kType>::Type* from) {
  if constexpr (kType == TableType::float32) {
    return *from;
  } else {
    return unpack_half<kType == TableType::bfloat16>(*from);
  }
}

// run(number of the first feature, x, y, z) for each corner.
template <int kFeatures, typename Run>
__device__ __forceinline__ void hash_corners(const HashAxis (&axes)[3], const GridLevel& level, int64_t first,
                                             const Run& run) {
#pragma unroll
  for (int corner = 0; corner < 8; ++corner) {
    const int x = corner & 1, y = corner >> 1 & 1, z = corner >> 2;
    const uint32_t entry = hash_entry(level, axes[0].corner + x, axes[1].corner + y, axes[2].corner + z);
    run(first + static_cast<int64_t>(entry) * kFeatures, x, y, z);
  }
}

}  // namespace voronerf
