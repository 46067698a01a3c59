// A cell may be named more than once: all named cells fade first, from what they were, then each value may raise its
// cell. The two passes over q are serial, being a fraction of what finding the values took.
#include "rays/update_occupancy.h"

#include <algorithm>

#include "common/common.h"

namespace voronerf {

bool update_occupancy_cpu(const float* density, const int32_t* rows, const float* values, float* result,
                          uint8_t* occupied, int64_t n, int64_t q, float decay, float threshold, int threads) {
  std::copy(density, density + n, result);
  for (int64_t i = 0; i < q; ++i) {
    if (rows[i] < 0 || rows[i] >= n) return false;
    result[rows[i]] = density[rows[i]] * decay;
  }
  for (int64_t i = 0; i < q; ++i) result[rows[i]] = std::max(result[rows[i]], values[i]);
#pragma omp parallel for schedule(static) num_threads(threads) if (threads > 1 && n > (1 << 16))
  for (int64_t i = 0; i < n; ++i) occupied[i] = result[i] >= threshold;
  return true;
}

}  // namespace voronerf
