// Device functions for hash grid look-ups, shared by the CUDA kernels: the numbers of a table, and the corners around a
// point.
//
// The features of an entry are loaded, added and stored together, in pieces of at most 16 bytes. The caller aligns
// tables and other arrays of features to 16 bytes.
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

// The features that one load or store moves.
template <typename Type, int kFeatures>
struct alignas(kFeatures * sizeof(Type) < 16 ? kFeatures * sizeof(Type) : 16) HashPiece {
  static constexpr int kCount = kFeatures * sizeof(Type) < 16 ? kFeatures : 16 / sizeof(Type);
  Type values[kCount];
};

template <TableType kType, int kFeatures>
__device__ __forceinline__ void hash_load(const typename HashElement<kType>::Type* from, float (&to)[kFeatures]) {
  using Piece = HashPiece<typename HashElement<kType>::Type, kFeatures>;
#pragma unroll
  for (int first = 0; first < kFeatures; first += Piece::kCount) {
    const Piece piece = *reinterpret_cast<const Piece*>(from + first);
#pragma unroll
    for (int f = 0; f < Piece::kCount; ++f) {
      if constexpr (kType == TableType::float32) {
        to[first + f] = piece.values[f];
      } else {
        to[first + f] = unpack_half<kType == TableType::bfloat16>(piece.values[f]);
      }
    }
  }
}

template <int kFeatures>
__device__ __forceinline__ void hash_store(float* to, const float (&values)[kFeatures]) {
  using Piece = HashPiece<float, kFeatures>;
#pragma unroll
  for (int first = 0; first < kFeatures; first += Piece::kCount) {
    Piece piece;
#pragma unroll
    for (int f = 0; f < Piece::kCount; ++f) piece.values[f] = values[first + f];
    *reinterpret_cast<Piece*>(to + first) = piece;
  }
}

// Adds to the gradient of an entry atomically. From sm_90 on one atomic operation takes several features.
template <int kFeatures>
__device__ __forceinline__ void hash_add(float* to, const float (&values)[kFeatures]) {
  constexpr int kCount = kFeatures < 4 ? kFeatures : 4;
#pragma unroll
  for (int f = 0; f < kFeatures; f += kCount) add_in_global<kCount>(to + f, values + f);
}

// Calls run(corner, x, y, z) for each of the eight corners; x, y and z are 0 at the lower and 1 at the upper corner of
// their axis.
template <typename Run>
__device__ __forceinline__ void for_each_corner(const Run& run) {
#pragma unroll
  for (int corner = 0; corner < 8; ++corner) run(corner, corner & 1, corner >> 1 & 1, corner >> 2);
}
// Calls run(index of the entry's first feature, x, y, z) for each corner.
template <int kFeatures, typename Run>
__device__ __forceinline__ void hash_corners(const HashAxis (&axes)[3], const GridLevel& level, int64_t first,
                                             const Run& run) {
  for_each_corner([&](int, int x, int y, int z) {
    const uint32_t entry = hash_entry(level, axes[0].corner + x, axes[1].corner + y, axes[2].corner + z);
    run(first + static_cast<int64_t>(entry) * kFeatures, x, y, z);
  });
}

}  // namespace voronerf
