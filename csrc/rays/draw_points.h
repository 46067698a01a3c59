// Draws n random points in a box. The formulas are in voronerf/ops/draw_points.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

// seed: [1]. box: [2,3]. points: [n,3].
void draw_points_cpu(const int32_t* seed, const float* box, RowCount n, float* points, int threads);
void draw_points_cuda(const int32_t* seed, const float* box, int64_t n, float* points, void* stream);

}  // namespace voronerf
