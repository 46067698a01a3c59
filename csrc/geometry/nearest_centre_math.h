// Arithmetic of nearest_centre, shared by its CPU and CUDA kernels.
//
// The answer is defined in float64: the lowest index that minimises |x - c|^2, evaluated as (dx^2 + dy^2) + dz^2 (and
// so on) with every operation rounded separately (no contraction to fma), so that all backends agree to the last bit.
//
// Float32 input is screened in float32, and decided in float64 only if float32 is not certain. Let u = 2^-24, D the
// squared distance, and V the value of D that float32 computes. A difference, a product and two sums round, so the
// error of V is at most g D, where g = 5u + O(u^2) < 3.6e-7; fused multiply-adds only reduce the error. Let b be the
// index of the smallest V. A centre nearer than b has D <= D_b (up to 1e-15, float64's own error), hence
// V <= V_b + 2 g V_b. If the second smallest V is above V_b + kMargin V_b + kFloor, no centre is nearer than b.
// kMargin = 2e-6 covers 2g and the roundings of this sum (3u). kFloor covers the underflow of the squares, whether it
// is flushed to zero or not. NaN and overflow fail the comparison and are decided in float64.
//
// The CPU stores an index in a value's lowest n bits, which changes the value by a factor of less than 1 + t, t =
// 2^(n-23). nearest_margin adds 2.5 t >= (1+t)/(1-t) - 1.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

constexpr float kMargin = 2e-6f;
constexpr float kFloor = 1e-36f;
constexpr double kLargest = 1.7976931348623157e308;

// Returns the margin for values whose lowest bits are an index.
VN_HD float nearest_margin(int index_bits) { return kMargin + 2.5f * static_cast<float>(1 << index_bits) / 8388608.0f; }

// Returns whether float32 has certainly found the nearest centre. `second` is the smallest computed value of all
// centres but the best one.
VN_HD bool nearest_is_certain(float best, float second) { return best + (kMargin * best + kFloor) < second; }

// Returns sum + d * d with both operations rounded. On the host -ffp-contract=off ensures this.
VN_HD double add_square(double sum, double d) {
#ifdef __CUDA_ARCH__
  return __dadd_rn(sum, __dmul_rn(d, d));
#else
  return sum + d * d;
#endif
}

// Returns the float64 value that defines the result, for one centre whose D coordinates have stride `apart`.
template <int D, typename T>
VN_HD double squared_distance(const double* point, const T* centre, int apart = 1) {
  double sum = 0.0;
  for (int axis = 0; axis < D; ++axis) sum = add_square(sum, point[axis] - static_cast<double>(centre[axis * apart]));
  return sum;
}

// Returns the nearest centre by definition. Strict comparison keeps the lowest of equal centres. NaN and infinity never
// compare as less, so that a non-finite point gets cell 0.
template <int D, typename T>
VN_HD int32_t nearest_by_definition(const T* point, const T* centres, int64_t k) {
  double at[D], best = kLargest;
  for (int axis = 0; axis < D; ++axis) at[axis] = static_cast<double>(point[axis]);
  int32_t cell = 0;
  for (int64_t j = 0; j < k; ++j) {
    const double v = squared_distance<D>(at, centres + D * j);
    if (v < best) {
      best = v;
      cell = static_cast<int32_t>(j);
    }
  }
  return cell;
}

}  // namespace voronerf
