// Keeps the heaviest samples of a batch, in place of the oldest batch's samples: b batches with q kept samples each, m
// samples in the batch, r rays, d coordinates. The formulas are in voronerf/ops/keep_heaviest.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct WeighedSamples {
  const float* points;       // [m,d]
  const float* weights;      // [m]
  const float* error;        // [r], which multiplies the weights; or null
  const int32_t* ray_index;  // [m], or null if error is null
  RowCount m, r;
  int64_t d;
};

struct KeptSamples {
  float* points;      // [b,q,d]
  float* importance;  // [b,q]
  int64_t* added;     // [1], the number of batches so far, which is incremented
  int64_t b, q;
};

// Returns the number of workspace entries.
int64_t keep_heaviest_workspace(int64_t q);

// Throws std::invalid_argument for a ray outside 0..r-1; `kept` is then unchanged.
void keep_heaviest_cpu(const WeighedSamples& in, const KeptSamples& kept, int64_t* workspace, int threads);

}  // namespace voronerf
