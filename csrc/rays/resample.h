// Hierarchical sampling: weights [r,s], edges [r,s+1], uniforms [r,count] or null (midpoints of equal strata) -> depths
// [r,count], increasing along a ray. s, count >= 1; r = 0 is legal. The formulas are in
// voronerf/ops/resample/reference.py.
#pragma once

#include <cstdint>

namespace voronerf {

void resample_cpu(const float* weights, const float* edges, const float* uniforms, float* depths, int64_t r, int64_t s,
                  int64_t count, int threads);

// workspace: r * s doubles.
void resample_cuda(const float* weights, const float* edges, const float* uniforms, float* depths, double* workspace,
                   int64_t r, int64_t s, int64_t count, void* stream);

}  // namespace voronerf
