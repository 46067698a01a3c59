// The kernels of adam, once for each instruction set: a step of entries [begin, end), and whether the magnitudes of a
// gradient [n] are all below a limit.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// A step of one parameter.
struct AdamStep {
  float step_size;        // the learning rate, corrected for the moments' start at zero
  float decay, decay_sq;  // of the moments
  float epsilon;          // corrected likewise
  bool every;             // entries without a gradient move on by their moments, which decay, as torch's do
};

VN_DECLARE_FOR_ISA(void adam_block(const AdamStep& rule, const float* gradient, float* parameter, float* mean,
                                   float* square, int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(bool adam_all_below(float limit, const float* gradient, int64_t n))

}  // namespace voronerf
