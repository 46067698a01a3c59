// Random numbers. Each is a hash of a seed, the index of a ray, and the index of the number within the ray, so it
// depends neither on the number of threads nor on the order in which the numbers are drawn.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

// Returns a hash of x: Chris Wellons' lowbias32.
VN_HD uint32_t mixed(uint32_t x) {
  x = (x ^ x >> 16) * 0x7feb352du;
  x = (x ^ x >> 15) * 0x846ca68bu;
  return x ^ x >> 16;
}

// `hash_key` returns the key of a ray. `hashed` returns the number with index `place` of the random numbers in [0, 1)
// that belong to a key. Multiples of 2^32 divided by the golden ratio keep the rays of near seeds apart.
constexpr uint32_t kGolden = 0x9e3779b9u;
VN_HD uint32_t hash_key(int32_t seed, int64_t ray) {
  return mixed(static_cast<uint32_t>(seed) * kGolden + static_cast<uint32_t>(ray));
}
VN_HD float hashed(uint32_t key, uint32_t place) {
  return static_cast<float>(static_cast<int32_t>(mixed(key ^ place * kGolden) >> 8)) * 0x1p-24f;
}

}  // namespace voronerf
