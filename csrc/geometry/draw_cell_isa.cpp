// The CPU kernel of draw_cell, once for each instruction set.
//
// Points lie in the lanes and every centre is broadcast, as in nearest_centre, in three passes over the centres: the
// smallest distance (8 operations a vector and centre); masses relative to it, which are then at most 1, and their
// running sums, kept in the workspace (a square root and an exponential, some 30 operations, only for centres near
// enough for one of the lanes: the others cost a comparison); how many sums lie below the target. A mass is 0 beyond
// e^-20 in every lane alike, so that a point's cell does not depend on its neighbours in the vector.
#include "common/elementwise_math.h"
#include "common/integer_tile.h"
#include "geometry/draw_cell.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr float kInfinity = __builtin_huge_valf();
constexpr float kReach = 20.0f;          // temperatures beyond the nearest centre at which there is no mass left
constexpr float kLeast = 5.9604645e-8f;  // 2^-24: 1 - u of the largest u below 1

// |x - c|^2, with weights + (heaviest - w): not negative, and of the order of the masses.
template <bool Weighted>
VN_INLINE F32 squared_distance(F32 x, F32 y, F32 z, const float* centres, const float* weights, float heaviest,
                               int64_t j) {
  const F32 dx = sub(x, splat(centres[3 * j])), dy = sub(y, splat(centres[3 * j + 1]));
  const F32 dz = sub(z, splat(centres[3 * j + 2]));
  const F32 squared = fma(dz, dz, fma(dy, dy, mul(dx, dx)));
  return Weighted ? add(squared, splat(heaviest - weights[j])) : squared;
}

template <bool Weighted>
VN_INLINE I32 vector(const float* points, const float* uniforms, const float* centres, const float* weights,
                     float heaviest, float temperature, float inverse, float* sums, int64_t k) {
  F32 x, y, z;
  load_points(points, x, y, z);
  F32 near = splat(kInfinity);
  // NaN is never the minimum: `min` returns its second operand then.
  for (int64_t j = 0; j < k; ++j) {
    near = min(squared_distance<Weighted>(x, y, z, centres, weights, heaviest, j), near);
  }
  const F32 root = square_root(near), reach = add(root, splat(kReach * temperature));
  // Above the smallest distance even where the temperature is lost in its rounding; not so where that is infinite, as
  // for a point that is not finite, which then has no mass anywhere.
  const F32 limit = max(mul(reach, reach), add(mul(near, splat(1.0000005f)), splat(1e-37f)));
  F32 total = splat(0.0f);
  for (int64_t j = 0; j < k; ++j) {
    const F32 squared = squared_distance<Weighted>(x, y, z, centres, weights, heaviest, j);
    const Mask reached = less(squared, limit);
    if (bits(reached) != 0) {
      const F32 mass = exponential(mul(sub(root, square_root(squared)), splat(inverse)));
      total = add(total, as_float(select(reached, as_integer(mass), splat(int32_t{0}))));
    }
    __builtin_memcpy(sums + kLanes * j, &total, sizeof total);
  }
  F32 u;
  __builtin_memcpy(&u, uniforms, sizeof u);
  // 1 - u: above 0, so that a centre without mass is never drawn, at most 1, so that the last with mass is the last;
  // NaN counts as 0.
  const F32 target = mul(max(min(sub(splat(1.0f), u), splat(1.0f)), splat(kLeast)), total);
  I32 cell = splat(int32_t{0});
  for (int64_t j = 0; j < k; ++j) {
    F32 sum;
    __builtin_memcpy(&sum, sums + kLanes * j, sizeof sum);
    cell = add(cell, select(less(sum, target), splat(int32_t{1}), splat(int32_t{0})));
  }
  return cell;
}

template <bool Weighted>
VN_INLINE void run(const float* points, const float* centres, const float* weights, const float* uniforms,
                   float temperature, float inverse, float* sums, int32_t* cells, int64_t n, int64_t k) {
  float heaviest = -kInfinity;
  if (Weighted) {
    for (int64_t j = 0; j < k; ++j) heaviest = weights[j] > heaviest ? weights[j] : heaviest;
  }
  for (int64_t i = 0; i < n; i += kLanes) {
    const int rows = n - i < kLanes ? static_cast<int>(n - i) : kLanes;
    if (rows == kLanes) {
      store(cells + i,
            vector<Weighted>(points + 3 * i, uniforms + i, centres, weights, heaviest, temperature, inverse, sums, k));
      continue;
    }
    float padded[3 * kLanes] = {}, drawn[kLanes] = {};
    int32_t found[kLanes];
    __builtin_memcpy(padded, points + 3 * i, sizeof(float) * 3 * rows);
    __builtin_memcpy(drawn, uniforms + i, sizeof(float) * rows);
    store(found, vector<Weighted>(padded, drawn, centres, weights, heaviest, temperature, inverse, sums, k));
    __builtin_memcpy(cells + i, found, sizeof(int32_t) * rows);
  }
}

}  // namespace

static_assert(kLanes <= kDrawLanes, "the workspace holds a sum for each lane");

void draw_cell(const float* points, const float* centres, const float* weights, const float* uniforms,
               float temperature, float inverse, float* sums, int32_t* cells, int64_t n, int64_t k) {
  if (weights == nullptr) {
    run<false>(points, centres, weights, uniforms, temperature, inverse, sums, cells, n, k);
  } else {
    run<true>(points, centres, weights, uniforms, temperature, inverse, sums, cells, n, k);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
