// Nearest centre on CUDA. Search of all centres: a thread has two points. Centres pass through shared memory in tiles;
// all threads of a block read the same address (a broadcast), and each read serves both points of a thread. Search of
// an index: half a warp has one point, and each of its threads has a child of a node or a centre of a leaf, like a lane
// on the CPU (centre_index_isa.cpp). Float32 input is screened and, rarely, decided again in float64 by
// nearest_centre_math.h. All indices are the same as on the CPU.
#include "common/cuda_wrappers.h"
#include "geometry/nearest_centre.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kTile = 512;  // centres: 8 KiB of shared memory, one 16-byte load each
constexpr int kPoints = 2;  // points of a thread
constexpr int kRun = 8;     // consecutive points of half a warp

template <int D>
__global__ void __launch_bounds__(kThreads, D < 3 ? 2 : 4)
    nearest_screened_kernel(const float* __restrict__ points, const float* __restrict__ centres,
                            const int32_t* __restrict__ rows, int32_t* __restrict__ cells, int64_t n, int64_t k) {
  VN_SHARED(tile, float4[kTile]);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kPoints * kThreads + threadIdx.x;
  const int64_t counted = rows == nullptr ? n : *rows;
  float at[kPoints][4] = {}, best[kPoints], second[kPoints];
  int32_t cell[kPoints];
#pragma unroll
  for (int p = 0; p < kPoints; ++p) {
    // Threads past the end take the last point, since they must reach the barriers.
    const int64_t i = first + p * kThreads < n ? first + p * kThreads : n - 1;
#pragma unroll
    for (int axis = 0; axis < D; ++axis) at[p][axis] = points[D * i + axis];
    best[p] = second[p] = INFINITY;
    cell[p] = 0;
  }
  for (int64_t start = 0; start < k; start += kTile) {
    const int count = static_cast<int>(k - start < kTile ? k - start : kTile);
    __syncthreads();  // all threads have read the previous tile
    for (int j = threadIdx.x; j < count; j += kThreads) {
      const float* c = centres + D * (start + j);
      tile[j] = make_float4(c[0], D > 1 ? c[1 % D] : 0.0f, D > 2 ? c[2 % D] : 0.0f, D > 3 ? c[3 % D] : 0.0f);
    }
    __syncthreads();
    const int32_t number = static_cast<int32_t>(start);
#pragma unroll 4
    for (int j = 0; j < count; ++j) {
      const float4 c = tile[j];
#pragma unroll
      for (int p = 0; p < kPoints; ++p) {
        const float dx = at[p][0] - c.x, dy = at[p][1] - c.y, dz = at[p][2] - c.z, dw = at[p][3] - c.w;
        float v = dx * dx;
        if (D > 1) v = fmaf(dy, dy, v);
        if (D > 2) v = fmaf(dz, dz, v);
        if (D > 3) v = fmaf(dw, dw, v);
        second[p] = fminf(second[p], fmaxf(v, best[p]));
        cell[p] = v < best[p] ? number + j : cell[p];
        best[p] = fminf(v, best[p]);
      }
    }
  }
#pragma unroll
  for (int p = 0; p < kPoints; ++p) {
    const int64_t i = first + p * kThreads;
    if (i >= n) return;
    const bool screened = nearest_is_certain(best[p], second[p]);
    const int32_t result = screened ? cell[p] : nearest_by_definition<D>(points + D * i, centres, k);
    cells[i] = i < counted ? result : -1;
  }
}

template <int D>
__global__ void __launch_bounds__(kThreads)
    nearest_centre_kernel(const double* __restrict__ points, const double* __restrict__ centres,
                          const int32_t* __restrict__ rows, int32_t* __restrict__ cells, int64_t n, int64_t k) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) cells[i] = rows == nullptr || i < *rows ? nearest_by_definition<D>(points + D * i, centres, k) : -1;
}

// Returns the minimum over half a warp.
template <typename T>
__device__ __forceinline__ T least_of_half(T x) {
#pragma unroll
  for (int step = kWide / 2; step > 0; step /= 2) {
    const T other = __shfl_xor_sync(kAllLanes, x, step);
    x = other < x ? other : x;
  }
  return x;
}

// Returns the squared distance from a point to a box, in the search's type. If `low` and `high` are the same, the box
// is a centre.
template <int D, typename S, typename T>
__device__ __forceinline__ S box_distance(const S* point, const T* low, const T* high, int apart) {
  S sum = 0;
#pragma unroll
  for (int axis = 0; axis < D; ++axis) {
    const S under = static_cast<S>(low[axis * apart]) - point[axis];
    const S over = point[axis] - static_cast<S>(high[axis * apart]);
    const S beyond = under > over ? under : over, d = beyond > S{0} ? beyond : S{0};
    if constexpr (sizeof(S) == 8) {
      sum = add_square(sum, d);
    } else {
      sum = fmaf(d, d, sum);
    }
  }
  return sum;
}

// `key_of` stores a child's number in the lowest bits of its distance; as integers, keys have the distances' order.
// `distance_of` reads the distance back.
template <typename Key, typename S>
__device__ __forceinline__ Key key_of(S v, int child) {
  static_assert(sizeof(Key) == sizeof(S), "the bits of the one are the other");
  Key key;
  memcpy(&key, &v, sizeof key);
  return (key & -Key{kWide}) | child;
}
template <typename S, typename Key>
__device__ __forceinline__ S distance_of(Key key) {
  key &= -Key{kWide};
  S v;
  memcpy(&v, &key, sizeof v);
  return v;
}

// The best and second best distance that a thread has seen among its centres.
template <typename S>
struct Seen {
  S best, second;
  int32_t cell;
};

// Searches in both halves of a warp in lockstep, one point each. A half that has finished, or has no point, waits. No
// centre within `bound` is skipped. In float64, ties go to the lowest number. `keys` holds the key of the thread's
// child on each level, 8 bytes each; a level's keys of all threads are adjacent.
template <int D, typename S, typename Key, typename T>
__device__ Seen<S> search(const S* point, bool wanted, S bound, const int32_t* index, const CentreIndexShape& shape,
                          Key* keys) {
  constexpr bool exact = sizeof(S) == 8;
  constexpr int apart = kThreads * (8 / sizeof(Key));
  const int lane = threadIdx.x % kWide;
  Seen<S> seen = {exact ? static_cast<S>(kLargest) : static_cast<S>(INFINITY), static_cast<S>(INFINITY), 0};
  int64_t node = 0;
  int level = wanted ? 0 : -1;
  while (__ballot_sync(kAllLanes, level >= 0) != 0) {
    const bool leaf = level == shape.levels;
    if (level >= 0) {
      const int words = leaf ? shape.leaf_words : shape.node_words;
      const T* values = reinterpret_cast<const T*>(index + shape.level_word[level] + node * words);
      const S v = box_distance<D>(point, values + lane, values + lane + (leaf ? 0 : kWide), leaf ? kWide : 2 * kWide);
      if (leaf) {
        const int32_t number = reinterpret_cast<const int32_t*>(values + D * kWide)[lane];
        const bool nearer = v < seen.best || (exact && v == seen.best && number < seen.cell);
        if (nearer) {
          seen = {v, seen.best, number};
        } else if (v < seen.second) {
          seen.second = v;
        }
        --level;
        node >>= 4;
      } else {
        keys[level * apart] = key_of<Key>(v, lane);
      }
    }
    const S best = least_of_half(seen.best), reach = exact ? best : best + (kMargin * best + kFloor);
    bound = reach < bound ? reach : bound;
    // Go to the nearest unvisited child of this node or of one above.
    for (bool looking = level >= 0; __ballot_sync(kAllLanes, looking) != 0;) {
      const Key own_key = looking ? keys[level * apart] : Key{0}, key = least_of_half(own_key);
      if (!looking) continue;
      if (distance_of<S>(key) <= bound) {
        if (own_key == key)
          keys[level * apart] = exact ? static_cast<Key>(0x7fffffffffffffff) : Key{0x7fffffff};  // NaN
        node = (node << 4) + static_cast<int64_t>(key & (kWide - 1));
        ++level;
        looking = false;
      } else {
        --level;
        node >>= 4;
        looking = level >= 0;
      }
    }
  }
  return seen;
}

template <int D, typename T>
__global__ void __launch_bounds__(kThreads)
    search_index_kernel(const T* __restrict__ points, const T* __restrict__ centres, const int32_t* __restrict__ index,
                        const int32_t* __restrict__ rows, int32_t* __restrict__ cells, int64_t n,
                        const VN_GRID_CONSTANT CentreIndexShape shape) {
  VN_SHARED(keys, long long[kMostLevels * kThreads]);
  auto* const float_keys = reinterpret_cast<int32_t*>(keys + threadIdx.x);  // the same memory for either type
  const int lane = threadIdx.x % kWide, half = threadIdx.x % 32 / kWide * kWide;
  const int64_t counted = rows == nullptr ? n : *rows;
  const int64_t first = (static_cast<int64_t>(blockIdx.x) * (kThreads / kWide) + threadIdx.x / kWide) * kRun;
  const bool fits = is_index_of(index, shape.k, D, sizeof(T));
  int32_t previous = -1;  // the previous point's cell
  for (int64_t i = first; i < first + kRun; ++i) {
    float near[D];
    double exact[D];
    bool wanted = fits && i < n && i < counted;
    for (int axis = 0; axis < D; ++axis) {
      exact[axis] = wanted ? static_cast<double>(points[D * i + axis]) : 0.0;
      near[axis] = static_cast<float>(exact[axis]);
      wanted = wanted && exact[axis] - exact[axis] == 0.0;
    }
    int32_t cell = 0;
    bool certain = !wanted;
    if constexpr (sizeof(T) == 4) {
      float bound = 3.4028235e38f, v = 0.0f;
      if (previous >= 0) {
        for (int axis = 0; axis < D; ++axis) {
          const float d = near[axis] - centres[D * static_cast<int64_t>(previous) + axis];
          v = fmaf(d, d, v);
        }
        bound = fminf(v + 2.0f * (kMargin * v + kFloor), bound);
      }
      const Seen<float> seen = search<D, float, int32_t, T>(near, wanted, bound, index, shape, float_keys);
      const float best = least_of_half(seen.best);
      const bool owns = seen.best == best;
      const unsigned owners = __ballot_sync(kAllLanes, owns) >> half & 0xffffu;
      const float others = least_of_half(owns ? seen.second : seen.best);
      const int32_t result = __shfl_sync(kAllLanes, seen.cell, half + __ffs(static_cast<int>(owners)) - 1);
      if (wanted && nearest_is_certain(best, (owners & (owners - 1)) != 0 ? best : others)) {
        certain = true;
        cell = result;
      }
    }
    if (__ballot_sync(kAllLanes, !certain) != 0) {
      const Seen<double> seen =
          search<D, double, long long, T>(exact, !certain, kLargest, index, shape, keys + threadIdx.x);
      const double best = least_of_half(seen.best);
      const int32_t result = least_of_half(seen.best == best ? seen.cell : INT32_MAX);
      if (!certain) cell = result;
    }
    previous = wanted ? cell : -1;
    if (lane == 0 && i < n) cells[i] = fits && i < counted ? cell : -1;
  }
}

unsigned blocks_of(int64_t n, int64_t points) { return static_cast<unsigned>(ceil_div<int64_t>(n, points)); }

template <int D, typename T>
void find(const T* points, const T* centres, const int32_t* index, const int32_t* rows, int32_t* cells, int64_t n,
          int64_t k, const CentreIndexShape& shape, void* stream) {
  if (index != nullptr) {
    VN_LAUNCH((search_index_kernel<D, T>), blocks_of(n, kThreads / kWide * kRun), kThreads, 0, stream, points, centres,
              index, rows, cells, n, shape);
  } else if constexpr (sizeof(T) == 4) {
    VN_LAUNCH((nearest_screened_kernel<D>), blocks_of(n, kPoints * kThreads), kThreads, 0, stream, points, centres,
              rows, cells, n, k);
  } else {
    VN_LAUNCH((nearest_centre_kernel<D>), blocks_of(n, kThreads), kThreads, 0, stream, points, centres, rows, cells, n,
              k);
  }
}

}  // namespace

template <typename T>
bool nearest_centre_cuda(const T* points, const T* centres, const int32_t* index, const int32_t* rows, int32_t* cells,
                         int64_t n, int64_t k, int64_t d, int64_t words, void* stream) {
  if (d < 1 || d > kMostAxes) return false;
  const CentreIndexShape shape = centre_index_shape(k, static_cast<int>(d), sizeof(T));
  if (index != nullptr && words != shape.words) return false;
  if (n == 0) return true;
  const auto run = d == 1 ? find<1, T> : d == 2 ? find<2, T> : d == 3 ? find<3, T> : find<4, T>;
  run(points, centres, index, rows, cells, n, k, shape, stream);
  return true;
}

template bool nearest_centre_cuda(const float*, const float*, const int32_t*, const int32_t*, int32_t*, int64_t,
                                  int64_t, int64_t, int64_t, void*);
template bool nearest_centre_cuda(const double*, const double*, const int32_t*, const int32_t*, int32_t*, int64_t,
                                  int64_t, int64_t, int64_t, void*);

}  // namespace voronerf
