// Nearest centre on the CPU: blocks of points over threads. A point's answer depends on that point alone, so the result
// does not depend on the number of threads.
#include "geometry/nearest_centre.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/common.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

// Points of a task: a few microseconds of work at small k, small enough to share n = 10,000 between two threads.
constexpr int64_t kBlock = 2048;

}  // namespace

template <typename T>
float nearest_centre_weight_bound(const T* weights, int64_t k) {
  if (weights == nullptr) return 0.0f;
  double bound = 0.0;
  for (int64_t j = 0; j < k; ++j) {
    // A weight of minus infinity never wins. One of infinity, or none at all, is left to float64, as are all points.
    if (weights[j] == -std::numeric_limits<T>::infinity()) continue;
    bound = std::max(bound, std::isnan(weights[j]) ? std::numeric_limits<double>::infinity()
                                                   : std::fabs(static_cast<double>(weights[j])));
  }
  // Where D overflows float32 but D - w does not, screening is void; an infinite bound sends every point to float64.
  return bound > 1e30 ? std::numeric_limits<float>::infinity() : static_cast<float>(bound);
}

template <typename T>
void nearest_centre_serial(const T* points, const T* centres, const T* weights, float weight_bound, int32_t* cells,
                           int64_t n, int64_t k, Isa isa) {
  VN_FOR_ISA(isa, nearest_centre(points, centres, weights, weight_bound, cells, n, k))
}

template <typename T>
void nearest_centre_cpu(const T* points, const T* centres, const T* weights, int32_t* cells, int64_t n, int64_t k,
                        Isa isa, int threads) {
  const float weight_bound = nearest_centre_weight_bound(weights, k);
  parallel_for(ceil_div(n, kBlock), 1, threads, [&](int64_t b) {
    const int64_t start = b * kBlock;
    nearest_centre_serial(points + 3 * start, centres, weights, weight_bound, cells + start,
                          std::min(kBlock, n - start), k, isa);
  });
}

template void nearest_centre_cpu(const float*, const float*, const float*, int32_t*, int64_t, int64_t, Isa, int);
template void nearest_centre_cpu(const double*, const double*, const double*, int32_t*, int64_t, int64_t, Isa, int);
template void nearest_centre_serial(const float*, const float*, const float*, float, int32_t*, int64_t, int64_t, Isa);
template void nearest_centre_serial(const double*, const double*, const double*, float, int32_t*, int64_t, int64_t,
                                    Isa);
template float nearest_centre_weight_bound(const float*, int64_t);
template float nearest_centre_weight_bound(const double*, int64_t);

}  // namespace voronerf
