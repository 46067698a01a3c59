// Nearest centre on the CPU: blocks of points over threads. A point's answer depends on that point alone, so the result
// does not depend on the number of threads.
#include "geometry/nearest_centre.h"

#include <algorithm>

#include "common/common.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

// Points of a task: a few microseconds of work at small k, small enough to share n = 10,000 between two threads.
constexpr int64_t kBlock = 2048;

}  // namespace

template <typename T>
void nearest_centre_serial(const T* points, const T* centres, int32_t* cells, int64_t n, int64_t k, Isa isa) {
  VN_FOR_ISA(isa, nearest_centre(points, centres, cells, n, k))
}

template <typename T>
void nearest_centre_cpu(const T* points, const T* centres, int32_t* cells, RowCount n, int64_t k, Isa isa,
                        int threads) {
  parallel_for(ceil_div<int64_t>(n, kBlock), 1, threads, [&](int64_t b) {
    const int64_t start = b * kBlock;
    nearest_centre_serial(points + 3 * start, centres, cells + start, std::min(kBlock, n - start), k, isa);
  });
}

template void nearest_centre_cpu(const float*, const float*, int32_t*, RowCount, int64_t, Isa, int);
template void nearest_centre_cpu(const double*, const double*, int32_t*, RowCount, int64_t, Isa, int);
template void nearest_centre_serial(const float*, const float*, int32_t*, int64_t, int64_t, Isa);
template void nearest_centre_serial(const double*, const double*, int32_t*, int64_t, int64_t, Isa);

}  // namespace voronerf
