// Arithmetic of the hash encoding for one point and one level, and the structs that describe a call. The CPU's vector
// form is in hash_encode_tile.h.
//
// The weights of the eight corners around a point are products of one factor for each axis: t or 1 - t, where t is the
// distance from the lower corner. Derivatives use the same corners with other factors.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

constexpr int kMaxHashLevels = 24;
constexpr uint32_t kHashPrimeY = 2654435761u, kHashPrimeZ = 805459861u;

// One level of a hash grid. The members have the same meanings as in GridLevel of voronerf/ops/_core/grids.py.
struct GridLevel {
  float scale, shift;
  int32_t side;     // stride of the second axis
  int64_t entries;  // at most 2^24
  int64_t offset;   // first entry in the table
  bool hashed;
};

enum class TableType : int { float32 = 0, bfloat16 = 1, float16 = 2 };

struct HashInputs {
  const float* positions;  // [n,3]
  const float* direction;  // [n,3], or null; if set, the result is the derivative along it
  const void* table;       // [tables, entries, features]
  TableType type;
  const int32_t* cells;  // [n], the table of each point; null if there is only one
  int64_t n, tables, entries;
};

// A call: its inputs, its levels, and the box as its lower corner and inverse size.
struct HashEncoding {
  HashInputs in;
  GridLevel levels[kMaxHashLevels];
  int32_t count, features;
  float low[3], inverse[3];
};

// A coordinate scaled to 0..1 (`place`), and the derivative of this scaling (`slope`), which is 0 outside the box. NaN
// stays NaN.
struct HashPlace {
  float place, slope;
};
VN_HD HashPlace hash_place(float x, float low, float inverse) {
  const float place = (x - low) * inverse;
  if (place < 0.0f) return {0.0f, 0.0f};
  if (place > 1.0f) return {1.0f, 0.0f};
  return {place, place == place ? inverse : 0.0f};
}

// One axis of a level: the lower corner, and for both the lower and the upper corner the factor of the weight and its
// derivative with respect to the scaled coordinate.
struct HashAxis {
  uint32_t corner;
  float at[2], slope[2];
};
VN_HD HashAxis hash_axis(float place, const GridLevel& level) {
  // The product and the sum are rounded separately, as in the reference, so that the corners are the same.
#ifdef __CUDA_ARCH__
  const float where = __fadd_rn(__fmul_rn(place, level.scale), level.shift);
#else
  const float where = place * level.scale + level.shift;
#endif
  HashAxis axis;
  axis.corner = where == where ? static_cast<uint32_t>(where) : 0u;  // never negative
  const float t = where - static_cast<float>(axis.corner);
  axis.at[0] = 1.0f - t, axis.at[1] = t;
  axis.slope[0] = -level.scale, axis.slope[1] = level.scale;
  return axis;
}

// Returns the entry of a corner within its level. A dense index is below twice the entries, because the last corners of
// an axis may lie one past its stride.
VN_HD uint32_t hash_entry(const GridLevel& level, uint32_t x, uint32_t y, uint32_t z) {
  const uint32_t entries = static_cast<uint32_t>(level.entries);
  if (level.hashed) return (x ^ y * kHashPrimeY ^ z * kHashPrimeZ) & (entries - 1u);
  const uint32_t side = static_cast<uint32_t>(level.side);
  const uint32_t entry = x + side * (y + side * z);
  return entry < entries ? entry : entry - entries;
}

// Returns the factor of a corner's entry: the weight or, if `directed`, the weight's derivative along the direction
// `along` [3].
VN_HD float hash_weight(const HashAxis* axes, bool directed, const float* along, int x, int y, int z) {
  const HashAxis &a = axes[0], &b = axes[1], &c = axes[2];
  if (!directed) return a.at[x] * (b.at[y] * c.at[z]);
  return along[0] * a.slope[x] * (b.at[y] * c.at[z]) +
         a.at[x] * (along[1] * b.slope[y] * c.at[z] + b.at[y] * (along[2] * c.slope[z]));
}

// Returns the derivative of hash_weight with respect to the scaled coordinate on axis i.
VN_HD float hash_weight_slope(const HashAxis* axes, bool directed, const float* along, int i, const int* corner) {
  const int j = (i + 1) % 3, k = (i + 2) % 3;
  const HashAxis &a = axes[i], &b = axes[j], &c = axes[k];
  const int x = corner[i], y = corner[j], z = corner[k];
  if (!directed) return a.slope[x] * (b.at[y] * c.at[z]);
  return a.slope[x] * (along[j] * b.slope[y] * c.at[z] + b.at[y] * (along[k] * c.slope[z]));
}

}  // namespace voronerf
