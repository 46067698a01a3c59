// A step of Adam of several parameters in one call; the formula is in voronerf/ops/adam.
#pragma once

#include <cstdint>
#include <vector>

#include "encoding/adam_isa.h"

namespace voronerf {

// The rule of a parameter. Its step is on the device, and its rate may be: on CUDA no host reads them.
struct AdamRule {
  double rate;           // the learning rate, where rate_at is null
  const float* rate_at;  // [1], or null
  float* step;           // [1], steps done; goes up by one unless the step is left out
  double decay, decay_sq, epsilon;
  bool every;  // as of AdamStep
};

// When a step is left out: where `found` is not 0. With a loss, it is set first: to whether the loss or a gradient of a
// parameter with `every` is not below `limit`, NaN included.
struct AdamGuard {
  const float* loss;  // [1], or null
  float limit;
  float* found;               // [1], or null for never
  float *skipped, *in_a_row;  // [1], how many steps were left out, and of the last ones; null without a loss
  const float* scale;         // [1], of which the gradients are multiples, or null; on CUDA
};

void adam_cpu(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
              float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
              Isa isa, int threads);

// Averages go a share [1] of the way to parameters, or to 0 where there are none.
void average_cpu(float* const* averages, const float* const* parameters, const float* share,
                 const std::vector<int64_t>& sizes, int threads);

// Gradients are added to totals.
void add_cpu(const float* const* gradients, float* const* totals, const std::vector<int64_t>& sizes, int threads);

// A step on CUDA, in two launches for 36 parameters. The floats of its workspace, for so many parameters.
int64_t adam_workspace_cuda(int64_t count);
void adam_cuda(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
               float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
               float* workspace, void* stream);

}  // namespace voronerf
