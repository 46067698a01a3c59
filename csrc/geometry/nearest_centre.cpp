// Nearest centre on the CPU: threads share blocks of points, and search an index or all centres. A point's cell depends
// on this point alone, so the result depends neither on the number of threads nor on the method.
#include "geometry/nearest_centre.h"

#include <algorithm>
#include <memory>

#include "common/common.h"
#include "common/parallel.h"
#include "geometry/nearest_centre_math.h"

namespace voronerf {

namespace {

// The points of one task: a few microseconds of work at small k, and few enough to share n = 10,000 between two
// threads.
constexpr int64_t kBlock = 2048;

// Returns whether building an index pays. Searching all centres takes 0.11 ns per point and centre (AVX-512). Searching
// an index takes some 100 ns per point, and building it 50 to 120 ns per centre. For d = 4 there is no vectorised
// search of all centres.
bool index_pays(int64_t n, int64_t k, int64_t d) { return d < 4 ? n >= 1024 && k >= 2048 : n >= 64; }

// Pads one or two coordinates to three.
template <typename T>
void pad(const T* from, T* to, int64_t rows, int64_t d) {
  for (int64_t i = 0; i < rows; ++i) {
    for (int64_t axis = 0; axis < 3; ++axis) to[3 * i + axis] = axis < d ? from[d * i + axis] : T{0};
  }
}

}  // namespace

template <typename T>
void nearest_centre_serial(const T* points, const T* centres, int32_t* cells, int64_t n, int64_t k, Isa isa) {
  VN_FOR_ISA(isa, nearest_centre(points, centres, cells, n, k))
}

template <typename T>
void search_index_serial(const T* points, const int32_t* index, int32_t* cells, int64_t n,
                         const CentreIndexShape& shape, int d, Isa isa) {
  VN_FOR_ISA(isa, search_index(points, index, cells, n, shape, d))
}

template <typename T>
bool nearest_centre_cpu(const T* points, const T* centres, const int32_t* index, int32_t* cells, RowCount n, int64_t k,
                        int64_t d, int64_t words, Isa isa, int threads) {
  if (d < 1 || d > kMostAxes) return false;
  const CentreIndexShape shape = centre_index_shape(k, static_cast<int>(d), sizeof(T));
  if (index != nullptr && (words != shape.words || !is_index_of(index, k, static_cast<int>(d), sizeof(T))))
    return false;
  std::unique_ptr<int32_t[]> built;
  std::unique_ptr<T[]> padded;
  if (index == nullptr && index_pays(n, k, d)) {
    built.reset(new int32_t[static_cast<size_t>(shape.words)]);
    index_centres_cpu(centres, built.get(), k, static_cast<int>(d), threads);
    index = built.get();
  } else if (index == nullptr && d < 3) {
    padded.reset(new T[static_cast<size_t>(3 * k)]);
    pad(centres, padded.get(), k, d);
  }
  parallel_for(ceil_div<int64_t>(n, kBlock), 1, threads, [&](int64_t b) {
    const int64_t start = b * kBlock, rows = std::min(kBlock, n - start);
    const T* const from = points + d * start;
    if (index != nullptr) {
      search_index_serial(from, index, cells + start, rows, shape, static_cast<int>(d), isa);
    } else if (d == 3) {
      nearest_centre_serial(from, centres, cells + start, rows, k, isa);
    } else if (d < 3) {
      T block[3 * kBlock];
      pad(from, block, rows, d);
      nearest_centre_serial(block, padded.get(), cells + start, rows, k, isa);
    } else {
      for (int64_t i = 0; i < rows; ++i) cells[start + i] = nearest_by_definition<4>(from + 4 * i, centres, k);
    }
  });
  return true;
}

template bool nearest_centre_cpu(const float*, const float*, const int32_t*, int32_t*, RowCount, int64_t, int64_t,
                                 int64_t, Isa, int);
template bool nearest_centre_cpu(const double*, const double*, const int32_t*, int32_t*, RowCount, int64_t, int64_t,
                                 int64_t, Isa, int);
template void nearest_centre_serial(const float*, const float*, int32_t*, int64_t, int64_t, Isa);
template void search_index_serial(const float*, const int32_t*, int32_t*, int64_t, const CentreIndexShape&, int, Isa);
template void search_index_serial(const double*, const int32_t*, int32_t*, int64_t, const CentreIndexShape&, int, Isa);
template void nearest_centre_serial(const double*, const double*, int32_t*, int64_t, int64_t, Isa);

}  // namespace voronerf
