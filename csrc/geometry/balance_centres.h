// Moves k centres until their cells hold equal importance, given by m samples. The algorithm is described in
// voronerf/ops/balance_centres.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

struct BalanceInputs {
  const float* samples;  // [m,3]
  const double* masses;  // [m]
  int64_t m, k;
  int64_t steps;
  double alpha;
  int64_t neighbours;  // 1 <= neighbours < k, or k == 1
};

// Returns the workspace's size in doubles.
int64_t balance_centres_workspace(int64_t k);

// centres [k,3] in and out; weights [k] receives the mass of each cell at the end; cells [m] is workspace.
void balance_centres_cpu(const BalanceInputs& in, float* centres, double* weights, int32_t* cells, double* workspace,
                         Isa isa, int threads);

}  // namespace voronerf
