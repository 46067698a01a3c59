// The CPU kernels of nearest_centre, compiled once per instruction set.
//
// Points lie in the lanes and every centre is broadcast: there is no reduction across lanes, and the state of a tile
// stays in registers while the centres, 12 bytes each, stream from the L1 cache. kTile vectors at a time hide the
// latency of the minima and share the broadcasts: four with 32 registers, two with 16.
//
// Values are not negative, so their bits have the same order as integers, and the lowest bits can hold the index of the
// centre. One logical operation and one integer minimum then replace a floating-point comparison, blend and minimum,
// which would compete with the multiplications for execution units. The second smallest value costs two operations a
// centre and proves the result (nearest_centre_math.h). Chunks of kChunk centres need 8 bits of index, which change a
// value by up to 3e-5 of it. In a generic scene about one point in 10,000 is decided again in float64, with 16 centres
// one in 100,000.
#include "common/integer_tile.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kTile = kRegisters / 8;
constexpr int64_t kChunk = 256;

// Returns the number of bits that number the centres of a chunk.
VN_INLINE int index_bits(int64_t k) {
  int bits = 0;
  while ((int64_t{1} << bits) < (k < kChunk ? k : kChunk)) ++bits;
  return bits;
}

// Finds the smallest and second smallest key of each lane over the centres of a chunk.
template <int U>
VN_INLINE void search(const F32* x, const F32* y, const F32* z, const float* centres, I32 distance_bits, int32_t count,
                      I32* near, I32* next) {
  for (int u = 0; u < U; ++u) {
    near[u] = splat(int32_t{0x7fffffff});
    next[u] = splat(int32_t{0x7f800000});  // infinity
  }
  I32 index = splat(int32_t{0});
#pragma GCC unroll 2
  for (int32_t j = 0; j < count; ++j) {
    const F32 cx = splat(centres[3 * j]), cy = splat(centres[3 * j + 1]), cz = splat(centres[3 * j + 2]);
    for (int u = 0; u < U; ++u) {
      const F32 dx = sub(cx, x[u]), dy = sub(cy, y[u]), dz = sub(cz, z[u]);
      const I32 key = tag(as_integer(fma(dz, dz, fma(dy, dy, mul(dx, dx)))), distance_bits, index);
      next[u] = min(max(key, near[u]), next[u]);
      near[u] = min(key, near[u]);
    }
    index = add(index, splat(int32_t{1}));
  }
}

template <int U>
VN_INLINE void tile(const float* points, const float* centres, int bits_taken, int32_t* cells, int64_t k) {
  F32 x[U], y[U], z[U], best[U], second[U];
  I32 near[U], next[U], cell[U];
  for (int u = 0; u < U; ++u) load_points(points + 3 * kLanes * u, x[u], y[u], z[u]);
  const I32 index_mask = splat((1 << bits_taken) - 1), distance_bits = splat(-(1 << bits_taken));
  const int32_t first = static_cast<int32_t>(k < kChunk ? k : kChunk);
  search<U>(x, y, z, centres, distance_bits, first, near, next);
  for (int u = 0; u < U; ++u) {
    best[u] = as_float(near[u]);
    second[u] = as_float(next[u]);
    cell[u] = both(near[u], index_mask);
  }
  for (int64_t start = kChunk; start < k; start += kChunk) {
    const int32_t count = static_cast<int32_t>(k - start < kChunk ? k - start : kChunk);
    search<U>(x, y, z, centres + 3 * start, distance_bits, count, near, next);
    for (int u = 0; u < U; ++u) {
      // If the best or the second value is NaN or infinite, float64 decides the lane's point. An infinity with index
      // bits is NaN.
      const F32 v = as_float(near[u]);
      second[u] = min(max(v, best[u]), min(as_float(next[u]), second[u]));
      cell[u] = select(less(v, best[u]), add(splat(static_cast<int32_t>(start)), both(near[u], index_mask)), cell[u]);
      best[u] = min(v, best[u]);
    }
  }
  const F32 relative = splat(nearest_margin(bits_taken));
  for (int u = 0; u < U; ++u) {
    int32_t* out = cells + kLanes * u;
    store(out, cell[u]);
    const F32 margin = add(mul(relative, best[u]), splat(kFloor));
    unsigned uncertain = ~bits(less(add(best[u], margin), second[u])) & ((1u << kLanes) - 1u);
    for (; uncertain != 0; uncertain &= uncertain - 1) {
      const int lane = __builtin_ctz(uncertain);
      out[lane] = nearest_by_definition<3>(points + 3 * (kLanes * u + lane), centres, k);
    }
  }
}

}  // namespace

void nearest_centre(const float* points, const float* centres, int32_t* cells, int64_t n, int64_t k) {
  const int bits_taken = index_bits(k);
  int64_t i = 0;
  for (; i + kTile * kLanes <= n; i += kTile * kLanes) {
    tile<kTile>(points + 3 * i, centres, bits_taken, cells + i, k);
  }
  for (; i < n; i += kLanes) {
    const int rest = n - i < kLanes ? static_cast<int>(n - i) : kLanes;
    float padded[3 * kLanes] = {};
    int32_t padded_cells[kLanes];
    __builtin_memcpy(padded, points + 3 * i, sizeof(float) * 3 * rest);
    tile<1>(padded, centres, bits_taken, padded_cells, k);
    __builtin_memcpy(cells + i, padded_cells, sizeof(int32_t) * rest);
  }
}

// Float64 evaluates the definition itself (squared_distance, on vectors), with the same layout.
void nearest_centre(const double* points, const double* centres, int32_t* cells, int64_t n, int64_t k) {
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
    for (int u = 0; u < kVectors; ++u) best[u] = F64{} + kLargest;
    for (int64_t j = 0; j < k; ++j) {
      const double* c = centres + 3 * j;
      for (int u = 0; u < kVectors; ++u) {
        const F64 dx = x[u] - c[0], dy = y[u] - c[1], dz = z[u] - c[2];
        const F64 v = dx * dx + dy * dy + dz * dz;
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
