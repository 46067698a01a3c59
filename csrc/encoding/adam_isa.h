// The CPU kernels of Adam, compiled once per instruction set. adam_block updates entries [begin, end); adam_all_below
// returns whether all magnitudes of a gradient [n] are below a limit.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// The constants of a step of one parameter.
struct AdamStep {
  float step_size;        // the learning rate, corrected for the moments' start at zero
  float decay, decay_sq;  // decay rates of the moments
  float fresh, fresh_sq;  // 1 - decay, before it is rounded to float32
  float epsilon;          // with the same correction
  bool dense;             // also update entries with zero gradient, as torch does
};

VN_DECLARE_FOR_ISA(void adam_block(const AdamStep& rule, const float* gradient, float* parameter, float* mean,
                                   float* square, int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(bool adam_all_below(float limit, const float* gradient, int64_t n))

}  // namespace voronerf
