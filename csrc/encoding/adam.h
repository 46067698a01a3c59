// One Adam step of several parameters in one call; the formula is in voronerf/ops/adam.
#pragma once

#include <cstdint>
#include <vector>

#include "encoding/adam_isa.h"

namespace voronerf {

// The update rule of a parameter. The step count is in the memory of the parameter's device, and the learning rate may
// be there too; with CUDA, the host reads neither.
struct AdamRule {
  double rate;           // the learning rate if rate_at is null
  const float* rate_at;  // [1], the learning rate, or null
  float* step;           // [1], completed steps; goes up by one unless the step is skipped
  double decay, decay_sq, epsilon;
  bool dense;  // as in AdamStep
};

// A NaN guard: the step is skipped if `skip` is not 0. If there is a loss, the step first sets `skip` to whether the
// loss or a gradient of a parameter with `dense` reaches `limit` or is NaN.
struct AdamGuard {
  const float* loss;  // [1], or null
  float limit;
  float* skip;                // [1], or null to never skip
  float *skipped, *in_a_row;  // [1], skipped steps in total, and in a row until this step; null without a loss
  const float* scale;         // [1], the loss scale that gradients are divided by, or null; CUDA only
};

void adam_cpu(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
              float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
              Isa isa, int threads);

// Moves averages towards the parameters, or towards 0 if `parameters` is null, by the fraction `share` [1] of the
// distance.
void average_cpu(float* const* averages, const float* const* parameters, const float* share,
                 const std::vector<int64_t>& sizes, int threads);

// adam_cuda makes a step in two launches per 36 parameters. adam_workspace_cuda returns the size, in floats, of its
// workspace for `count` parameters.
int64_t adam_workspace_cuda(int64_t count);
void adam_cuda(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
               float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
               float* workspace, void* stream);

}  // namespace voronerf
