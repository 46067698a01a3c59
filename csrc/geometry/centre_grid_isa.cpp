// The kernels of the centre grid, once for each instruction set: striking candidates out of a box, and the query.
//
// Query: points lie in the lanes. A lane follows the entries from the root grid to its list and then walks its list in
// step with the others; tables come through gathers, which keep many cache misses under way at once where a loop a
// point would wait for each and mispredict its end. The float32 values of the candidates are screened as in
// nearest_centre, and where they do not decide, the list is searched in float64.
//
// Striking out: the eight corners of the box lie in the lanes of float64 vectors.
#include "geometry/centre_grid_isa.h"

#include "common/integer_tile.h"
#include "geometry/centre_grid_math.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kCorners = 8;
constexpr int kVectors = kCorners / kDoubles;
// Pairs are compared up to this many survivors of the first round: it is short lists that queries wait for.
constexpr int32_t kPairs = 32;
// Above twice 6 * 2^-53, the error of a value in |x - c|^2, for two values, here and in the definition; and above
// the underflow of squares.
constexpr double kValueMargin = 4e-15;
constexpr double kValueFloor = 1e-300;

// Whether all of a are above those of b.
VN_INLINE bool all_above(const double* a, const double* b) {
#if VN_ISA == 2
  return _mm512_cmp_pd_mask(_mm512_loadu_pd(a), _mm512_loadu_pd(b), _CMP_GT_OQ) == 0xff;
#elif VN_ISA == 1
  const __m256d low = _mm256_cmp_pd(_mm256_loadu_pd(a), _mm256_loadu_pd(b), _CMP_GT_OQ);
  const __m256d high = _mm256_cmp_pd(_mm256_loadu_pd(a + 4), _mm256_loadu_pd(b + 4), _CMP_GT_OQ);
  return _mm256_movemask_pd(_mm256_and_pd(low, high)) == 0xf;
#else
  for (int i = 0; i < kCorners; ++i) {
    if (!(a[i] > b[i])) return false;
  }
  return true;
#endif
}

// Cells along an axis, kCellBits each; `near` is where the grid reaches.
VN_INLINE I32 cells_of(F32 x, float middle, float inverse, Mask& near) {
  const F32 u = mul(sub(x, splat(middle)), splat(inverse)), size = abs(u), one = splat(1.0f);
  near = less(size, splat(static_cast<float>(kReach)));
  const F32 outside = sub(one, divide(one, max(size, one)));
  const F32 drawn = add(min(size, one), mul(outside, splat(1.0f / 3.0f)));
  const F32 p = as_float(tag(as_integer(drawn), splat(0x7fffffff), both(as_integer(u), splat(INT32_MIN))));
  const F32 scaled = mul(add(p, splat(4.0f / 3.0f)), splat(0.375f * (1 << kCellBits)));
  // NaN is looked up in cell 0.
  return truncate(max(min(scaled, splat(static_cast<float>((1 << kCellBits) - 1))), splat(0.0f)));
}

VN_INLINE void lanes(const float* points, const float* centres, const CentreGrid& grid, int32_t* cells) {
  F32 x, y, z;
  load_points(points, x, y, z);
  Mask near[3];
  const I32 cx = cells_of(x, grid.frame[0], grid.frame[3], near[0]);
  const I32 cy = cells_of(y, grid.frame[1], grid.frame[4], near[1]);
  const I32 cz = cells_of(z, grid.frame[2], grid.frame[5], near[2]);
  int shift = kCellBits - grid.bits;
  I32 entry = gather(grid.entries,
                     add(left(add(left(right(cx, shift), grid.bits), right(cy, shift)), grid.bits), right(cz, shift)));
  const I32 zero = splat(int32_t{0}), low = splat((1 << kBrickBits) - 1);
  for (Mask brick = less(entry, zero); bits(brick) != 0; brick = less(entry, zero)) {
    shift -= kBrickBits;
    const I32 dx = both(right(cx, shift), low), dy = both(right(cy, shift), low), dz = both(right(cz, shift), low);
    const I32 inside = add(left(add(left(dx, kBrickBits), dy), kBrickBits), dz);
    // ~entry is -1 - entry.
    const I32 place = select(brick, add(subtract(splat(int32_t{-1}), entry), inside), zero);
    entry = select(brick, gather(grid.entries, place), entry);
  }
  const I32 count = gather(grid.lists, entry);
  F32 best = splat(__builtin_huge_valf()), second = best;
  I32 cell = zero;
  for (int32_t i = 1;; ++i) {
    const Mask active = less(splat(i - 1), count);
    if (bits(active) == 0) break;
    // The walk of a lane whose list has ended stays at its last candidate.
    const I32 candidate = gather(grid.lists, add(entry, min(splat(i), count)));
    const I32 row = left(candidate, 2);
    const F32 dx = sub(x, gather(grid.table, row)), dy = sub(y, gather(grid.table + 1, row));
    const F32 dz = sub(z, gather(grid.table + 2, row));
    F32 v = fma(dz, dz, fma(dy, dy, mul(dx, dx)));
    v = as_float(select(active, as_integer(v), as_integer(splat(__builtin_huge_valf()))));
    // min and max return their second operand if one is NaN: a NaN leaves `best` alone.
    second = min(max(v, best), second);
    cell = select(less(v, best), candidate, cell);
    best = min(v, best);
  }
  store(cells, cell);
  const F32 margin = add(mul(splat(kMargin), best), splat(kFloor));
  const unsigned all = (1u << kLanes) - 1u, reached = bits(near[0]) & bits(near[1]) & bits(near[2]) & all;
  unsigned uncertain = ~bits(less(add(best, margin), second)) & reached;
  if (uncertain != 0) {
    int32_t places[kLanes];
    store(places, entry);
    for (; uncertain != 0; uncertain &= uncertain - 1) {
      const int lane = __builtin_ctz(uncertain);
      cells[lane] = nearest_of_list(points + 3 * lane, centres, grid.lists + places[lane]);
    }
  }
  for (unsigned far = ~reached & all; far != 0; far &= far - 1) cells[__builtin_ctz(far)] = -1;
}

}  // namespace

void nearest_centre_grid(const float* points, const float* centres, const CentreGrid& grid, int32_t* cells, int64_t n) {
  int64_t i = 0;
  for (; i + kLanes <= n; i += kLanes) {
    lanes(points + 3 * i, centres, grid, cells + i);
  }
  if (i == n) return;
  float padded[3 * kLanes] = {};
  int32_t found[kLanes];
  __builtin_memcpy(padded, points + 3 * i, sizeof(float) * 3 * (n - i));
  lanes(padded, centres, grid, found);
  __builtin_memcpy(cells + i, found, sizeof(int32_t) * (n - i));
}

int32_t centre_grid_prune(const double* box, const double* centres, const int32_t* in, int32_t count, int32_t* out,
                          double* workspace) {
  double x[kCorners], y[kCorners], z[kCorners];
  for (int i = 0; i < kCorners; ++i) {
    x[i] = box[i & 1 ? 3 : 0];
    y[i] = box[i & 2 ? 4 : 1];
    z[i] = box[i & 4 ? 5 : 2];
  }
  F64 xs[kVectors], ys[kVectors], zs[kVectors];
  __builtin_memcpy(xs, x, sizeof x);
  __builtin_memcpy(ys, y, sizeof y);
  __builtin_memcpy(zs, z, sizeof z);
  const double mx = 0.5 * (box[0] + box[3]), my = 0.5 * (box[1] + box[4]), mz = 0.5 * (box[2] + box[5]);

  // Bounds of each value at the corners, margin included: the first candidate loses to the second where all of its
  // lower bounds are above the other's upper ones. The margin is convex, so it covers the inside of the box too.
  double *lower = workspace, *upper = workspace + kCorners * static_cast<int64_t>(count), least = 0.0;
  F64 lowest[kVectors] = {};
  I64 nearest[kVectors] = {};
  int64_t strong[kCorners + 1] = {};
  for (int32_t i = 0; i < count; ++i) {
    const double* c = centres + 3 * static_cast<int64_t>(in[i]);
    for (int v = 0; v < kVectors; ++v) {
      const F64 dx = xs[v] - c[0], dy = ys[v] - c[1], dz = zs[v] - c[2];
      const F64 value = dx * dx + dy * dy + dz * dz, margin = value * kValueMargin + kValueFloor;
      const F64 a = value - margin, b = value + margin;
      __builtin_memcpy(lower + kCorners * static_cast<int64_t>(i) + kDoubles * v, &a, sizeof a);
      __builtin_memcpy(upper + kCorners * static_cast<int64_t>(i) + kDoubles * v, &b, sizeof b);
      if (i == 0) lowest[v] = value;
      const I64 less = value < lowest[v];
      nearest[v] = less ? I64{} + i : nearest[v];
      lowest[v] = less ? value : lowest[v];
    }
    const double inside = squared_distance(mx, my, mz, c);
    if (i == 0 || inside < least) {
      least = inside;
      strong[0] = i;
    }
  }
  // Most lose to the centre nearest to the middle of the box or to one of its corners.
  for (int i = 0; i < kCorners; ++i) strong[1 + i] = nearest[i / kDoubles][i % kDoubles];
  int32_t left_over = 0;
  for (int32_t i = 0; i < count; ++i) {
    bool beaten = false;
    for (int s = 0; s <= kCorners && !beaten; ++s) {
      beaten = all_above(lower + kCorners * static_cast<int64_t>(i), upper + kCorners * strong[s]);
    }
    if (!beaten) out[left_over++] = i;
  }
  // One that is itself beaten may beat others: who beats it beats them as well.
  int32_t kept = 0;
  for (int32_t i = 0; i < left_over; ++i) {
    const int32_t one = out[i];
    bool beaten = false;
    for (int32_t j = 0; left_over <= kPairs && j < left_over && !beaten; ++j) {
      const int64_t other = out[j] < 0 ? ~out[j] : out[j];
      beaten = all_above(lower + kCorners * static_cast<int64_t>(one), upper + kCorners * other);
    }
    if (beaten) out[i] = ~one;
  }
  for (int32_t i = 0; i < left_over; ++i) {
    if (out[i] >= 0) out[kept++] = in[out[i]];
  }
  return kept;
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
