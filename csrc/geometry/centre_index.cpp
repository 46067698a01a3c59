// Builds an index by splits from the root down; each split selects the median. A range's bounds follow from its depth
// and number alone, so threads build whole subtrees independently.
#include "geometry/centre_index.h"

#include <algorithm>
#include <limits>
#include <memory>

#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int kSharedBits = 4;  // levels of splits before threads share the subtrees
constexpr int kSample = 31;     // size of the sample that chooses a pivot
constexpr int kFew = 200;       // range size up to which sampling does not pay

template <typename T, int D>
struct Centre {
  T at[D];
  int32_t number;
};

template <typename T>
struct Pivot {
  T value;
  int32_t number;
};

// Returns whether a centre is before the pivot, ties by number. It has no branches.
template <typename T, int D>
bool is_before(const Centre<T, D>& centre, int axis, const Pivot<T>& pivot) {
  const T value = centre.at[axis];
  return (value < pivot.value) | ((value == pivot.value) & (centre.number < pivot.number));
}

// Partitions centres around the one at `middle`, like Floyd and Rivest ("Expected time bounds for selection", 1975).
// The pivot is the element of a sample at the middle's relative rank. The sample is random, since centres may come in
// any regular order.
template <typename T, int D>
void select_middle(Centre<T, D>* centres, int64_t begin, int64_t end, int64_t middle, int axis) {
  uint64_t state = static_cast<uint64_t>(middle);
  while (end - begin > kFew) {
    Pivot<T> sample[kSample];
    for (Pivot<T>& element : sample) {
      state = 6364136223846793005u * state + 1442695040888963407u;  // Knuth's generator
      const Centre<T, D>& chosen =
          centres[begin + static_cast<int64_t>((state >> 33) % static_cast<uint64_t>(end - begin))];
      element = {chosen.at[axis], chosen.number};
    }
    std::sort(sample, sample + kSample, [](const Pivot<T>& a, const Pivot<T>& b) {
      return (a.value < b.value) | ((a.value == b.value) & (a.number < b.number));
    });
    const int64_t rank = (middle - begin) * kSample / (end - begin);
    const Pivot<T> pivot = sample[std::clamp<int64_t>(rank, 1, kSample - 2)];
    int64_t filled = begin;
    for (int64_t i = begin; i < end; ++i) {
      const Centre<T, D> moved = centres[i];
      const bool before = is_before(moved, axis, pivot);
      centres[i] = centres[filled];
      centres[filled] = moved;
      filled += before;
    }
    (filled <= middle ? begin : end) = filled;
  }
  std::nth_element(centres + begin, centres + middle, centres + end, [axis](const auto& a, const auto& b) {
    return a.at[axis] < b.at[axis] || (a.at[axis] == b.at[axis] && a.number < b.number);
  });
}

template <typename T, int D>
class Builder {
 public:
  Builder(const T* input, int32_t* index, int64_t k)
      : shape_(centre_index_shape(k, D, sizeof(T))), index_(index), centres_(new Centre<T, D>[k]) {
    for (int64_t i = 0; i < k; ++i) {
      for (int axis = 0; axis < D; ++axis) {
        const T value = input[D * i + axis];  // NaN has no order; it becomes infinity, never the nearest
        centres_[i].at[axis] = value == value ? value : std::numeric_limits<T>::infinity();
      }
      centres_[i].number = static_cast<int32_t>(i);
    }
    std::fill_n(index, kHead, 0);
    index[0] = static_cast<int32_t>(k);
    index[1] = D;
    index[2] = sizeof(T);
    // Missing children get empty boxes, which no search enters.
    T* const root = values(0, 0, shape_.node_words);
    for (int i = 0; i < D * kWide && shape_.levels > 0; ++i) {
      root[2 * kWide * (i / kWide) + i % kWide] = std::numeric_limits<T>::infinity();
      root[2 * kWide * (i / kWide) + kWide + i % kWide] = -std::numeric_limits<T>::infinity();
    }
  }

  void build(int threads) {
    const int shared = std::min(shape_.bits, kSharedBits);
    split(0, 0, shared);
    if (shared == shape_.bits) return;
    parallel_for(int64_t{1} << shared, 1, threads, [&](int64_t i) { split(shared, i, shape_.bits); });
  }

 private:
  int64_t first(int depth, int64_t i) const { return shape_.k * (i << (shape_.bits - depth)) >> shape_.bits; }
  T* values(int level, int64_t i, int words) const {
    return reinterpret_cast<T*>(index_ + shape_.level_word[level] + i * words);
  }

  // Splits range i of level `depth` recursively, down to level `until`.
  void split(int depth, int64_t i, int until) {
    const int64_t begin = first(depth, i), end = first(depth, i + 1);
    const int root = root_bits(shape_.bits);
    if (depth == until && until < shape_.bits) return;
    T low[D], high[D];
    for (int axis = 0; axis < D; ++axis) {
      low[axis] = std::numeric_limits<T>::infinity();
      high[axis] = -low[axis];
    }
    for (int64_t c = begin; c < end; ++c) {
      for (int axis = 0; axis < D; ++axis) {
        const T value = centres_[c].at[axis];
        low[axis] = value < low[axis] ? value : low[axis];
        high[axis] = value > high[axis] ? value : high[axis];
      }
    }
    if (depth > 0 && (depth - root) % 4 == 0) {
      const int level = (depth - root) / 4, bits = level == 0 ? root : 4;
      T* const node = values(level, i >> bits, shape_.node_words) + (i & ((1 << bits) - 1));
      for (int axis = 0; axis < D; ++axis) {
        node[2 * kWide * axis] = low[axis];
        node[2 * kWide * axis + kWide] = high[axis];
      }
    }
    if (depth == shape_.bits) return fill_leaf(i, begin, end);
    int longest = 0;
    for (int axis = 1; axis < D; ++axis) {
      if (high[axis] - low[axis] > high[longest] - low[longest]) longest = axis;
    }
    select_middle(centres_.get(), begin, end, first(depth + 1, 2 * i + 1), longest);
    split(depth + 1, 2 * i, until);
    split(depth + 1, 2 * i + 1, until);
  }

  void fill_leaf(int64_t i, int64_t begin, int64_t end) const {
    T* const leaf = values(shape_.levels, i, shape_.leaf_words);
    auto* const numbers = reinterpret_cast<int32_t*>(leaf + D * kWide);
    for (int j = 0; j < kWide; ++j) {
      const bool exists = begin + j < end;
      for (int axis = 0; axis < D; ++axis) {
        leaf[axis * kWide + j] = exists ? centres_[begin + j].at[axis] : std::numeric_limits<T>::infinity();
      }
      numbers[j] = exists ? centres_[begin + j].number : std::numeric_limits<int32_t>::max();
    }
  }

  const CentreIndexShape shape_;
  int32_t* const index_;
  const std::unique_ptr<Centre<T, D>[]> centres_;
};

}  // namespace

int64_t centre_index_words(int64_t k, int d, int bytes) { return centre_index_shape(k, d, bytes).words; }

template <typename T>
void index_centres_cpu(const T* centres, int32_t* index, int64_t k, int d, int threads) {
  switch (d) {
    case 1:
      return Builder<T, 1>(centres, index, k).build(threads);
    case 2:
      return Builder<T, 2>(centres, index, k).build(threads);
    case 3:
      return Builder<T, 3>(centres, index, k).build(threads);
    default:
      return Builder<T, 4>(centres, index, k).build(threads);
  }
}

template void index_centres_cpu(const float*, int32_t*, int64_t, int, int);
template void index_centres_cpu(const double*, int32_t*, int64_t, int, int);

}  // namespace voronerf
