// The kernels of the centre grid (centre_grid.h), once for each instruction set.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

struct CentreGrid {
  const float* frame;
  const int32_t *entries, *lists;
  const float* table;  // [k,4]: a centre and a zero, of float32 queries; null for float64
  int bits;
};

// Rows on the calling thread; -1 for points beyond the reach of the grid.
VN_DECLARE_FOR_ISA(void nearest_centre_grid(const float* points, const float* centres, const CentreGrid& grid,
                                            int32_t* cells, int64_t n))

// Removes from `count` candidates those that another beats in the box (lowest, highest corner), and returns how many
// stay. centres [k,3]; workspace of kPruneWorkspace doubles a candidate.
constexpr int64_t kPruneWorkspace = 16;
VN_DECLARE_FOR_ISA(int32_t centre_grid_prune(const double* box, const double* centres, const int32_t* in, int32_t count,
                                             int32_t* out, double* workspace))

}  // namespace voronerf
