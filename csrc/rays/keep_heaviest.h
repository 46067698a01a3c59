// Keeps the heaviest samples of a batch in place of those of the oldest: b batches, q samples kept of each, m samples
// of the batch, r rays, d coordinates. What it computes is said in voronerf/ops/keep_heaviest.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct WeighedSamples {
  const float* points;       // [m,d]
  const float* weights;      // [m]
  const float* error;        // [r], or null for weights as they are
  const int32_t* ray_index;  // [m], or null with error
  RowCount m, r;
  int64_t d;
};

struct KeptSamples {
  float* points;      // [b,q,d]
  float* importance;  // [b,q]
  int64_t* added;     // [1], batches so far; becomes one more
  int64_t b, q;
};

// Entries of working memory.
int64_t keep_heaviest_workspace(int64_t q);

// found: working memory. Throws std::invalid_argument for a ray that is not there, and keeps nothing then.
void keep_heaviest_cpu(const WeighedSamples& in, const KeptSamples& kept, int64_t* found, int threads);

}  // namespace voronerf
