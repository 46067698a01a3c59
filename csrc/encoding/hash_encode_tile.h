// The hash encoding of a block of points, level by level: corners and weights in vectors of points, entries one point
// at a time.
//
// Each point and level needs eight loads at random addresses. The other work must not cost more than these loads.
// Indices and weights, some 60 operations for a whole vector, pass through the L1 cache, and an entry of two features
// takes one load, one broadcast of its weight and one multiply-add. On Zen 5, gathers in place of these loads
// are 50 % slower, because they are microcoded. The arithmetic of one point is in hash_encode_math.h.
#pragma once

#include "common/memory_tile.h"
#include "encoding/hash_encode_isa.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

typedef int32_t HashInts __attribute__((vector_size(4 * kLanes)));
typedef uint32_t HashWords __attribute__((vector_size(4 * kLanes)));

// The points of a block, by axis: coordinates scaled to 0..1 (see HashPlace), the derivatives of this scaling, and
// these derivatives times the direction.
struct HashPlaces {
  alignas(64) float place[3][kHashBlock], slope[3][kHashBlock], along[3][kHashBlock];
};

// The entries of the corners on one level (x varies fastest, then y and z) and their factors: one set of weights, or
// three sets for the derivatives with respect to the scaled coordinates.
struct HashCorners {
  alignas(64) int32_t entry[8][kHashBlock];
  alignas(64) float weight[3][8][kHashBlock];
};

// Returns points [rows,3], padded with zeros to a whole block.
VN_INLINE const float* whole_block(const float* from, int64_t rows, float* padded) {
  if (rows == kHashBlock) return from;
  __builtin_memset(padded, 0, 3 * sizeof(float) * kHashBlock);
  __builtin_memcpy(padded, from, 3 * sizeof(float) * rows);
  return padded;
}

// Computes the scaled coordinates of points `first` to `first + rows`, at most a block.
VN_INLINE void hash_places(const HashEncoding& in, int64_t first, int64_t rows, HashPlaces& to) {
  alignas(64) float padded[3 * kHashBlock], padded_direction[3 * kHashBlock];
  const float* points = whole_block(in.in.positions + 3 * first, rows, padded);
  const float* directions = in.in.direction;
  if (directions != nullptr) directions = whole_block(directions + 3 * first, rows, padded_direction);
  for (int64_t i = 0; i < rows; i += kLanes) {
    F32 x[3], v[3] = {};
    load_points(points + 3 * i, x[0], x[1], x[2]);
    if (directions != nullptr) load_points(directions + 3 * i, v[0], v[1], v[2]);
    for (int axis = 0; axis < 3; ++axis) {
      const F32 inverse = splat(in.inverse[axis]), place = (x[axis] - splat(in.low[axis])) * inverse;
      const HashInts inside = (place >= splat(0.0f)) & (place <= splat(1.0f));
      const F32 slope = reinterpret_cast<F32>(reinterpret_cast<HashInts>(inverse) & inside);
      store(to.place[axis] + i, min(splat(1.0f), max(splat(0.0f), place)));  // keeps NaN, the second operand
      store(to.slope[axis] + i, slope);
      store(to.along[axis] + i, slope * v[axis]);
    }
  }
}

// The vector form of HashAxis. `along` is the slope times the direction.
struct HashVectorAxis {
  HashWords corner;
  F32 at[2], slope[2], along[2];
};

VN_INLINE HashVectorAxis hash_vector_axis(F32 place, F32 along, const GridLevel& level) {
  const F32 one = splat(1.0f), zero = splat(0.0f), scale = splat(level.scale);
  const F32 where = place * scale + splat(level.shift);
  // `where` is not negative, so the conversion rounds down. NaN converts to the smallest integer.
  HashInts below = __builtin_convertvector(where, HashInts);
  below = below & ~(below >> 31);
  const F32 t = where - __builtin_convertvector(below, F32);
  HashVectorAxis axis;
  axis.corner = reinterpret_cast<HashWords>(below);
  axis.at[0] = one - t, axis.at[1] = t;
  axis.slope[0] = zero - scale, axis.slope[1] = scale;
  axis.along[1] = along * scale, axis.along[0] = zero - axis.along[1];
  return axis;
}

VN_INLINE void hash_entries(const HashVectorAxis* axes, const GridLevel& level, HashCorners& to, int64_t i) {
  const HashWords x = axes[0].corner, y = axes[1].corner, z = axes[2].corner;
  const uint32_t entries = static_cast<uint32_t>(level.entries), side = static_cast<uint32_t>(level.side);
  const HashWords ys[2] = {y * kHashPrimeY, (y + 1u) * kHashPrimeY}, zs[2] = {z * kHashPrimeZ, (z + 1u) * kHashPrimeZ};
  const HashWords first = x + (y + z * side) * side;
  for (uint32_t corner = 0; corner < 8; ++corner) {
    const uint32_t dx = corner & 1u, dy = corner >> 1 & 1u, dz = corner >> 2;
    HashWords entry;
    if (level.hashed) {
      entry = ((x + dx) ^ ys[dy] ^ zs[dz]) & (entries - 1u);
    } else {
      entry = first + (dx + (dy + dz * side) * side);
      entry = entry >= entries ? entry - entries : entry;
    }
    __builtin_memcpy(to.entry[corner] + i, &entry, sizeof entry);
  }
}

// Computes the corners of a level. kAlong: weights of the derivative along the direction. kSlopes: weights of the
// derivatives with respect to each scaled coordinate.
template <bool kAlong, bool kSlopes>
VN_INLINE void hash_corners(const GridLevel& level, const HashPlaces& places, int64_t rows, HashCorners& to) {
  for (int64_t i = 0; i < rows; i += kLanes) {
    HashVectorAxis axes[3];
    for (int axis = 0; axis < 3; ++axis) {
      axes[axis] = hash_vector_axis(load(places.place[axis] + i), load(places.along[axis] + i), level);
    }
    hash_entries(axes, level, to, i);
    const HashVectorAxis &a = axes[0], &b = axes[1], &c = axes[2];
    for (int corner = 0; corner < 8; ++corner) {
      const int x = corner & 1, y = corner >> 1 & 1, z = corner >> 2;
      const F32 at = b.at[y] * c.at[z], along = b.along[y] * c.at[z] + b.at[y] * c.along[z];
      if (!kSlopes) {
        store(to.weight[0][corner] + i, kAlong ? a.along[x] * at + a.at[x] * along : a.at[x] * at);
        continue;
      }
      F32 by_x = a.slope[x] * at, by_y = a.at[x] * (b.slope[y] * c.at[z]), by_z = a.at[x] * (b.at[y] * c.slope[z]);
      if (kAlong) {
        by_x = a.slope[x] * along;
        by_y = a.along[x] * (b.slope[y] * c.at[z]) + a.at[x] * (b.slope[y] * c.along[z]);
        by_z = a.along[x] * (b.at[y] * c.slope[z]) + a.at[x] * (b.along[y] * c.slope[z]);
      }
      store(to.weight[0][corner] + i, by_x);
      store(to.weight[1][corner] + i, by_y);
      store(to.weight[2][corner] + i, by_z);
    }
  }
}

// The features of an entry, four to a vector; lanes without a feature are 0.
typedef float Four __attribute__((vector_size(16)));
typedef uint32_t FourWords __attribute__((vector_size(16)));
typedef uint16_t FourHalves __attribute__((vector_size(8)));
typedef double TwoDoubles __attribute__((vector_size(16)));
template <int kFeatures>
struct Features {
  static constexpr int kParts = kFeatures == 8 ? 2 : 1;
  static constexpr int kLoaded = kFeatures < 4 ? kFeatures : 4;  // features in a part
  Four part[kParts];
};
struct Bfloat16 {
  uint16_t bits;
};
struct Float16 {
  uint16_t bits;
};

VN_INLINE Four widen(FourWords bits, Bfloat16) { return reinterpret_cast<Four>(bits << 16); }
VN_INLINE Four widen(FourWords bits, Float16) {
#if VN_ISA == 2
  return _mm_maskz_cvtph_ps(0xf, _mm_cvtepi32_epi16(reinterpret_cast<__m128i>(bits)));
#else
  // A multiplication shifts the exponent, so that subnormals become normal. An exponent of all ones stays all ones.
  const FourWords size = (bits & 0x7fffu) << 13;
  const FourWords scaled = reinterpret_cast<FourWords>(reinterpret_cast<Four>(size) * 0x1p112f);
  const FourWords infinite = reinterpret_cast<FourWords>(size >= 0x0f800000u) & 0x7f800000u;
  return reinterpret_cast<Four>(scaled | infinite | (bits & 0x8000u) << 16);
#endif
}

// Loads a part of an entry: one, two or four numbers, then zeros. Two floats pass through a double, because writing
// them to memory and reading a vector back would stall on store forwarding.
template <int kLoaded>
VN_INLINE Four load_part(const float* from) {
  if (kLoaded == 1) return Four{*from, 0.0f, 0.0f, 0.0f};
  if (kLoaded == 2) {
    double two;
    __builtin_memcpy(&two, from, sizeof two);
    return reinterpret_cast<Four>(TwoDoubles{two, 0.0});
  }
  Four four;
  __builtin_memcpy(&four, from, sizeof four);
  return four;
}
template <int kLoaded, typename Half>
VN_INLINE Four load_part(const Half* from) {
  uint64_t bits = 0;
  __builtin_memcpy(&bits, from, sizeof(Half) * kLoaded);
  return widen(__builtin_convertvector(reinterpret_cast<FourHalves>(bits), FourWords), Half{});
}
template <int kLoaded>
VN_INLINE void store_part(float* to, Four from) {
  if (kLoaded == 1) {
    *to = from[0];
  } else if (kLoaded == 2) {
    const double two = reinterpret_cast<TwoDoubles>(from)[0];
    __builtin_memcpy(to, &two, sizeof two);
  } else {
    __builtin_memcpy(to, &from, sizeof from);
  }
}

template <int kFeatures, typename T>
VN_INLINE Features<kFeatures> load_entry(const T* from) {
  using Entry = Features<kFeatures>;
  Entry to;
  for (int p = 0; p < Entry::kParts; ++p) to.part[p] = load_part<Entry::kLoaded>(from + 4 * p);
  return to;
}
template <int kFeatures>
VN_INLINE void store_entry(float* to, const Features<kFeatures>& from) {
  using Entry = Features<kFeatures>;
  for (int p = 0; p < Entry::kParts; ++p) store_part<Entry::kLoaded>(to + 4 * p, from.part[p]);
}

VN_INLINE Four multiply_add(Four a, float b, Four c) {
#if VN_ISA == 0
  return a * b + c;
#elif VN_ISA == 3
  return fma(a, splat(b), c);
#else
  return _mm_fmadd_ps(a, _mm_set1_ps(b), c);
#endif
}

// Returns the level's part of the table that a point reads.
template <int kFeatures, typename T>
VN_INLINE T* table_of(const HashEncoding& in, T* level, int64_t point) {
  return in.in.cells == nullptr ? level : level + in.in.cells[point] * in.in.entries * kFeatures;
}

// The size in bytes from which a level does not fit in the L2 cache together with the other levels, so that prefetching
// pays.
constexpr int64_t kFetchedLevel = 1 << 20;

// Prefetches the entries of all points of a block on one level, since out-of-order execution reaches only a few points
// ahead. Corners that differ in x alone mostly share a cache line.
template <int kFeatures, typename T>
VN_INLINE void hash_fetch(const HashEncoding& in, const GridLevel& level, const HashCorners& corners, int64_t first,
                          int64_t rows) {
  const T* table = static_cast<const T*>(in.in.table) + level.offset * kFeatures;
  for (int64_t i = 0; i < rows; ++i) {
    const T* entries_of_point = table_of<kFeatures>(in, table, first + i);
    for (int corner = 0; corner < 8; corner += 2) {
      __builtin_prefetch(entries_of_point + int64_t{corners.entry[corner][i]} * kFeatures);
    }
  }
}

// Writes the features of one level for points `first` to `first + rows`; rows of the result are `stride` apart.
template <int kFeatures, typename T>
VN_INLINE void hash_interpolate(const HashEncoding& in, const GridLevel& level, const HashCorners& corners,
                                int64_t first, int64_t rows, float* out, int64_t stride) {
  const T* table = static_cast<const T*>(in.in.table) + level.offset * kFeatures;
  for (int64_t i = 0; i < rows; ++i) {
    const T* entries_of_point = table_of<kFeatures>(in, table, first + i);
    Features<kFeatures> even{}, odd{};  // two sums halve the dependency chain
#pragma GCC unroll 4
    for (int corner = 0; corner < 8; corner += 2) {
      const auto a = load_entry<kFeatures>(entries_of_point + int64_t{corners.entry[corner][i]} * kFeatures);
      const auto b = load_entry<kFeatures>(entries_of_point + int64_t{corners.entry[corner + 1][i]} * kFeatures);
#pragma GCC unroll 2
      for (int p = 0; p < a.kParts; ++p) {
        even.part[p] = multiply_add(a.part[p], corners.weight[0][corner][i], even.part[p]);
        odd.part[p] = multiply_add(b.part[p], corners.weight[0][corner + 1][i], odd.part[p]);
      }
    }
    for (int p = 0; p < even.kParts; ++p) even.part[p] += odd.part[p];
    store_entry(out + i * stride, even);
  }
}

// Adds weights times gradients to the entries of one level; rows of `gradient` are `stride` apart.
template <int kFeatures>
VN_INLINE void hash_scatter(const HashEncoding& in, const GridLevel& level, const HashCorners& corners, int64_t first,
                            int64_t rows, const float* gradient, int64_t stride, float* of_table) {
  float* table = of_table + level.offset * kFeatures;
  for (int64_t i = 0; i < rows; ++i) {
    float* entries_of_point = table_of<kFeatures>(in, table, first + i);
    const auto arriving = load_entry<kFeatures>(gradient + i * stride);
    for (int corner = 0; corner < 8; ++corner) {
      float* at = entries_of_point + int64_t{corners.entry[corner][i]} * kFeatures;
      auto entry = load_entry<kFeatures>(at);
      for (int p = 0; p < entry.kParts; ++p) entry.part[p] += arriving.part[p] * corners.weight[0][corner][i];
      store_entry(at, entry);
    }
  }
}

// Adds one level's gradients with respect to the scaled coordinates (HashPlace) to sums [3][block]. Each sum is a
// vector; the caller must still add up its lanes.
template <int kFeatures, typename T>
VN_INLINE void hash_slopes(const HashEncoding& in, const GridLevel& level, const HashCorners& corners, int64_t first,
                           int64_t rows, const float* gradient, int64_t stride, Four (*sums)[kHashBlock]) {
  const T* table = static_cast<const T*>(in.in.table) + level.offset * kFeatures;
  for (int64_t i = 0; i < rows; ++i) {
    const T* entries_of_point = table_of<kFeatures>(in, table, first + i);
    const auto arriving = load_entry<kFeatures>(gradient + i * stride);
    Four slopes[3] = {};
    for (int corner = 0; corner < 8; ++corner) {
      const auto entry = load_entry<kFeatures>(entries_of_point + int64_t{corners.entry[corner][i]} * kFeatures);
      Four product = entry.part[0] * arriving.part[0];
      for (int p = 1; p < entry.kParts; ++p) product += entry.part[p] * arriving.part[p];
      for (int axis = 0; axis < 3; ++axis) {
        slopes[axis] = multiply_add(product, corners.weight[axis][corner][i], slopes[axis]);
      }
    }
    for (int axis = 0; axis < 3; ++axis) sums[axis][i] += slopes[axis];
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
