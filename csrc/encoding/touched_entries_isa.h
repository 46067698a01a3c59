// The kernels of touched_entries, once for each instruction set.
#pragma once

#include "encoding/touched_entries.h"

namespace voronerf {

VN_DECLARE_FOR_ISA(int64_t pack_touched_entries(const float* gradient, int64_t n, float* message))
// Returns the length that the bits say; adds nothing beyond `length`.
VN_DECLARE_FOR_ISA(int64_t add_touched_entries(const float* message, int64_t length, int64_t n, float* total))

}  // namespace voronerf
