// Searches an index of centres; compiled once per instruction set. It searches one point at a time, with the children
// of a node or the centres of a leaf in the lanes.
//
// The nearest child is searched first, and a box that is farther than the best centre is skipped. A box's squared
// distance uses the same operations as a centre's. Rounding is monotonic, so the box's distance never exceeds the
// distance of a centre in it. Float32 skips only boxes beyond nearest_is_certain's margin, so the final check covers
// all centres. If the check fails, the point is searched again in float64.
//
// Consecutive points lie along rays, so the previous point's nearest centre bounds the search of the next point.
#include "common/integer_tile.h"
#include "geometry/centre_index.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kParts = kWide / kLanes;  // vectors of a node's children
constexpr int32_t kDone = 0x7fffffff;   // key of a visited child; NaN as a float
constexpr float kHuge = 3.4028235e38f;

// Returns the values of node i of a level, or of leaf i.
template <typename T>
VN_INLINE const T* values(const int32_t* index, const CentreIndexShape& shape, int level, int64_t i) {
  const int words = level < shape.levels ? shape.node_words : shape.leaf_words;
  return reinterpret_cast<const T*>(index + shape.level_word[level] + i * words);
}

template <typename T, int D>
VN_INLINE bool is_finite(const T* point) {
  bool finite = true;
  for (int axis = 0; axis < D; ++axis) finite &= point[axis] - point[axis] == T{0};
  return finite;
}

template <typename T, int D>
VN_INLINE double squared_distance_of_box(const T* low, const double* point) {
  double sum = 0.0;
  for (int axis = 0; axis < D; ++axis) {
    const double under = static_cast<double>(low[2 * kWide * axis]) - point[axis];
    const double over = point[axis] - static_cast<double>(low[2 * kWide * axis + kWide]);
    const double beyond = under > over ? under : over, d = beyond > 0.0 ? beyond : 0.0;
    sum = add_square(sum, d);
  }
  return sum;
}

// Searches exactly, in float64. A box at the best distance is searched too, since it may hold a lower number.
template <typename T, int D>
int32_t search_exactly(const T* input, const int32_t* index, const CentreIndexShape& shape) {
  double point[D], distances[kMostLevels][kWide], best = kLargest;
  for (int axis = 0; axis < D; ++axis) point[axis] = static_cast<double>(input[axis]);
  int64_t node = 0;
  int32_t cell = 0;
  int level = 0;
  while (level >= 0) {
    if (level == shape.levels) {
      const T* leaf = values<T>(index, shape, level, node);
      const auto* numbers = reinterpret_cast<const int32_t*>(leaf + D * kWide);
      for (int i = 0; i < kWide; ++i) {
        const double v = squared_distance<D>(point, leaf + i, kWide);
        if (v < best || (v == best && numbers[i] < cell)) {
          best = v;
          cell = numbers[i];
        }
      }
      --level;
      node >>= 4;
    } else {
      const T* low = values<T>(index, shape, level, node);
      for (int i = 0; i < kWide; ++i) distances[level][i] = squared_distance_of_box<T, D>(low + i, point);
    }
    for (; level >= 0; --level, node >>= 4) {
      double* const remaining = distances[level];
      int nearest = 0;
      for (int i = 1; i < kWide; ++i) nearest = remaining[i] < remaining[nearest] ? i : nearest;
      if (!(remaining[nearest] <= best)) continue;
      remaining[nearest] = __builtin_inf();
      node = (node << 4) + nearest;
      ++level;
      break;
    }
  }
  return cell;
}

VN_INLINE float scalar(int32_t bits) {
  float value;
  __builtin_memcpy(&value, &bits, sizeof value);
  return value;
}

VN_INLINE F32 load(const float* from) {
  F32 a;
  __builtin_memcpy(&a, from, sizeof a);
  return a;
}

VN_INLINE I32 numbers_from(int32_t first) {
  int32_t numbers[kLanes];
  for (int i = 0; i < kLanes; ++i) numbers[i] = first + i;
  I32 result;
  __builtin_memcpy(&result, numbers, sizeof result);
  return result;
}

template <int D>
VN_INLINE F32 distance(const float* at, const F32* point) {
  const F32 first = sub(load(at), point[0]);
  F32 sum = mul(first, first);
  for (int axis = 1; axis < D; ++axis) {
    const F32 d = sub(load(at + axis * kWide), point[axis]);
    sum = fma(d, d, sum);
  }
  return sum;
}

template <int D>
VN_INLINE F32 box_distance(const float* low, const F32* point) {
  F32 sum = splat(0.0f);
  for (int axis = 0; axis < D; ++axis) {
    const F32 under = sub(load(low + 2 * kWide * axis), point[axis]);
    const F32 over = sub(point[axis], load(low + 2 * kWide * axis + kWide));
    const F32 d = max(max(under, over), splat(0.0f));
    sum = axis == 0 ? mul(d, d) : fma(d, d, sum);
  }
  return sum;
}

// The nearest centre of one point: its cell, and its address in the index.
struct Found {
  const float* at;  // first coordinate of the centre; null if float32 is too coarse
  int32_t cell;
};

// Searches in float32. `bound` is a squared distance within which there is a centre.
template <int D>
VN_INLINE Found search(const float* input, const int32_t* index, const CentreIndexShape& shape, float bound) {
  F32 point[D], near[kParts], next[kParts];
  I32 where[kParts], lanes[kParts];
  for (int axis = 0; axis < D; ++axis) point[axis] = splat(input[axis]);
  const F32 infinity = splat(__builtin_inff());
  const I32 distance_bits = splat(-kWide);
  for (int p = 0; p < kParts; ++p) {
    near[p] = next[p] = infinity;
    where[p] = splat(int32_t{0});
    lanes[p] = numbers_from(p * kLanes);
  }
  int32_t children[kMostLevels][kWide];  // distances of the current path's children; the lowest bits number the child
  int level = 0;
  int64_t node = 0;
  while (level >= 0) {
    if (level == shape.levels) {
      const float* leaf = values<float>(index, shape, level, node);
      const I32 number = splat(static_cast<int32_t>(node));
      F32 least = infinity;
      for (int p = 0; p < kParts; ++p) {
        const F32 v = distance<D>(leaf + p * kLanes, point);
        next[p] = min(max(v, near[p]), next[p]);
        where[p] = select(less(v, near[p]), number, where[p]);
        near[p] = min(v, near[p]);
        least = min(near[p], least);
      }
      const float best = scalar(smallest(as_integer(least))), reach = best + (kMargin * best + kFloor);
      bound = reach < bound ? reach : bound;
      --level;
      node >>= 4;
    } else {
      const float* low = values<float>(index, shape, level, node);
      for (int p = 0; p < kParts; ++p) {
        const F32 v = box_distance<D>(low + p * kLanes, point);
        store(children[level] + p * kLanes, tag(as_integer(v), distance_bits, lanes[p]));
      }
    }
    for (; level >= 0; --level, node >>= 4) {  // go to the nearest unvisited child of this node or of one above
      I32 keys[kParts];
      __builtin_memcpy(keys, children[level], sizeof keys);
      I32 least = keys[0];
      for (int p = 1; p < kParts; ++p) least = min(least, keys[p]);
      const int32_t key = smallest(least);
      if (!(scalar(key & -kWide) <= bound)) continue;
      for (int p = 0; p < kParts; ++p) {
        store(children[level] + p * kLanes, select(less(splat(key), keys[p]), keys[p], splat(kDone)));
      }
      node = (node << 4) + (key & (kWide - 1));
      ++level;
      break;
    }
  }
  F32 least = near[0];
  for (int p = 1; p < kParts; ++p) least = min(near[p], least);
  const float best = scalar(smallest(as_integer(least)));
  F32 others = infinity;
  unsigned equal = 0;
  int32_t leaves[kWide];
  for (int p = 0; p < kParts; ++p) {
    const Mask more = less(splat(best), near[p]);
    others = min(min(next[p], as_float(select(more, as_integer(near[p]), as_integer(infinity)))), others);
    equal |= (~bits(more) & ((1u << kLanes) - 1u)) << (p * kLanes);
    store(leaves + p * kLanes, where[p]);
  }
  const float second = (equal & (equal - 1)) != 0 ? best : scalar(smallest(as_integer(others)));
  if (!nearest_is_certain(best, second)) return {nullptr, 0};
  const int lane = __builtin_ctz(equal);
  const float* leaf = values<float>(index, shape, shape.levels, leaves[lane]);
  return {leaf + lane, reinterpret_cast<const int32_t*>(leaf + D * kWide)[lane]};
}

template <int D>
void search_all(const float* points, const int32_t* index, int32_t* cells, int64_t n, const CentreIndexShape& shape) {
  const float* previous = nullptr;  // the previous point's centre
  for (int64_t i = 0; i < n; ++i) {
    const float* point = points + D * i;
    if (!is_finite<float, D>(point)) {
      cells[i] = 0;
      continue;
    }
    float bound = kHuge;
    if (previous != nullptr) {
      float v = 0.0f;
      for (int axis = 0; axis < D; ++axis)
        v += (point[axis] - previous[axis * kWide]) * (point[axis] - previous[axis * kWide]);
      bound = v + 2.0f * (kMargin * v + kFloor);
      bound = bound < kHuge ? bound : kHuge;
    }
    const Found result = search<D>(point, index, shape, bound);
    previous = result.at;
    cells[i] = result.at == nullptr ? search_exactly<float, D>(point, index, shape) : result.cell;
  }
}

template <int D>
void search_all(const double* points, const int32_t* index, int32_t* cells, int64_t n, const CentreIndexShape& shape) {
  for (int64_t i = 0; i < n; ++i) {
    const double* point = points + D * i;
    cells[i] = is_finite<double, D>(point) ? search_exactly<double, D>(point, index, shape) : 0;
  }
}

template <typename T>
VN_INLINE void search_in(const T* points, const int32_t* index, int32_t* cells, int64_t n,
                         const CentreIndexShape& shape, int d) {
  switch (d) {
    case 1:
      return search_all<1>(points, index, cells, n, shape);
    case 2:
      return search_all<2>(points, index, cells, n, shape);
    case 3:
      return search_all<3>(points, index, cells, n, shape);
    default:
      return search_all<4>(points, index, cells, n, shape);
  }
}

}  // namespace

void search_index(const float* points, const int32_t* index, int32_t* cells, int64_t n, const CentreIndexShape& shape,
                  int d) {
  search_in(points, index, cells, n, shape, d);
}

void search_index(const double* points, const int32_t* index, int32_t* cells, int64_t n, const CentreIndexShape& shape,
                  int d) {
  search_in(points, index, cells, n, shape, d);
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
