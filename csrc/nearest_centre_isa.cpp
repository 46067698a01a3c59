// The CPU kernels of nearest_centre, once for each instruction set.
//
// Points lie in the lanes and every centre is broadcast: no reduction across lanes, and all state of a tile
// (coordinates, smallest and second smallest value, index) stays in registers while the centres, 12 bytes each, stream
// from the first- level cache. kTile vectors at a time hide the latency of the compare-and-blend chain and share the
// broadcasts: four with 32 registers, two with 16. The second smallest value costs two operations a centre and proves
// the answer (nearest_centre_math.h); about one point in a million of a generic scene is decided again in float64.
#include "nearest_centre_math.h"
#include "simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kTile = VN_ISA == 2 ? 4 : 2;
constexpr float kInfinity = __builtin_huge_valf();

template <int U, bool Weighted>
VN_INLINE void tile(const float* points, const float* centres, const float* weights, float weight_bound, int32_t* cells,
                    int64_t k) {
  F32 x[U], y[U], z[U], best[U], second[U];
  I32 cell[U];
  for (int u = 0; u < U; ++u) {
    load_points(points + 3 * kLanes * u, x[u], y[u], z[u]);
    best[u] = second[u] = splat(kInfinity);
    cell[u] = splat(int32_t{0});
  }
  for (int64_t j = 0; j < k; ++j) {
    const F32 cx = splat(centres[3 * j]), cy = splat(centres[3 * j + 1]), cz = splat(centres[3 * j + 2]);
    const I32 index = splat(static_cast<int32_t>(j));
    for (int u = 0; u < U; ++u) {
      const F32 dx = sub(x[u], cx), dy = sub(y[u], cy), dz = sub(z[u], cz);
      F32 v = fma(dz, dz, fma(dy, dy, mul(dx, dx)));
      if (Weighted) v = sub(v, splat(weights[j]));
      // min and max return their second operand if one is NaN: a NaN leaves `best` alone.
      second[u] = min(max(v, best[u]), second[u]);
      cell[u] = select(less(v, best[u]), index, cell[u]);
      best[u] = min(v, best[u]);
    }
  }
  for (int u = 0; u < U; ++u) {
    int32_t* out = cells + kLanes * u;
    store(out, cell[u]);
    const F32 margin = add(mul(splat(kMargin), add(abs(best[u]), splat(weight_bound))), splat(kFloor));
    unsigned uncertain = ~bits(less(add(best[u], margin), second[u])) & ((1u << kLanes) - 1u);
    for (; uncertain != 0; uncertain &= uncertain - 1) {
      const int lane = __builtin_ctz(uncertain);
      out[lane] = nearest_by_definition(points + 3 * (kLanes * u + lane), centres, weights, k);
    }
  }
}

template <bool Weighted>
VN_INLINE void run(const float* points, const float* centres, const float* weights, float weight_bound, int32_t* cells,
                   int64_t n, int64_t k) {
  int64_t i = 0;
  for (; i + kTile * kLanes <= n; i += kTile * kLanes) {
    tile<kTile, Weighted>(points + 3 * i, centres, weights, weight_bound, cells + i, k);
  }
  for (; i < n; i += kLanes) {
    const int rest = n - i < kLanes ? static_cast<int>(n - i) : kLanes;
    float padded[3 * kLanes] = {};
    int32_t found[kLanes];
    __builtin_memcpy(padded, points + 3 * i, sizeof(float) * 3 * rest);
    tile<1, Weighted>(padded, centres, weights, weight_bound, found, k);
    __builtin_memcpy(cells + i, found, sizeof(int32_t) * rest);
  }
}

}  // namespace

void nearest_centre(const float* points, const float* centres, const float* weights, float weight_bound, int32_t* cells,
                    int64_t n, int64_t k) {
  if (weights == nullptr) {
    run<false>(points, centres, weights, weight_bound, cells, n, k);
  } else {
    run<true>(points, centres, weights, weight_bound, cells, n, k);
  }
}

// Float64 is the definition itself (power_distance, here on vectors), with the same layout.
void nearest_centre(const double* points, const double* centres, const double* weights, float, int32_t* cells,
                    int64_t n, int64_t k) {
  constexpr int kVectors = 2, kRows = kVectors * kDoubles;
  for (int64_t i = 0; i < n; i += kRows) {
    const int rows = n - i < kRows ? static_cast<int>(n - i) : kRows;
    F64 x[kVectors] = {}, y[kVectors] = {}, z[kVectors] = {}, best[kVectors];
    I64 cell[kVectors] = {};
    for (int r = 0; r < rows; ++r) {
      x[r / kDoubles][r % kDoubles] = points[3 * (i + r)];
      y[r / kDoubles][r % kDoubles] = points[3 * (i + r) + 1];
      z[r / kDoubles][r % kDoubles] = points[3 * (i + r) + 2];
    }
    for (int u = 0; u < kVectors; ++u) best[u] = F64{} + 1.7976931348623157e308;
    for (int64_t j = 0; j < k; ++j) {
      const double* c = centres + 3 * j;
      const double w = weights == nullptr ? 0.0 : weights[j];
      for (int u = 0; u < kVectors; ++u) {
        const F64 dx = x[u] - c[0], dy = y[u] - c[1], dz = z[u] - c[2];
        const F64 v = dx * dx + dy * dy + dz * dz - w;
        const I64 less = v < best[u];
        cell[u] = less ? I64{} + j : cell[u];
        best[u] = less ? v : best[u];
      }
    }
    for (int r = 0; r < rows; ++r) cells[i + r] = static_cast<int32_t>(cell[r / kDoubles][r % kDoubles]);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
