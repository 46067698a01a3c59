// Updates an occupancy grid: n cells, q updates. The formula is in
// voronerf/ops/update_occupancy.
#pragma once

#include <cstdint>

namespace voronerf {

// density: [n], rows: [q] numbers of cells, values: [q] -> result: [n], occupied: [n], 0 or 1. Returns false, with
// undefined results, if a number is not that of a cell.
bool update_occupancy_cpu(const float* density, const int32_t* rows, const float* values, float* result,
                          uint8_t* occupied, int64_t n, int64_t q, float decay, float threshold, int threads);
// Numbers that are not those of a cell are left out.
void update_occupancy_cuda(const float* density, const int32_t* rows, const float* values, float* result,
                           uint8_t* occupied, int64_t n, int64_t q, float decay, float threshold, void* stream);

}  // namespace voronerf
