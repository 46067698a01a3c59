// The loops of measure_peak, once for each instruction set (measure_peak_isa.cpp).
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// Runs a block of independent multiply-adds `turns` times and returns its floating-point operations per turn. The sums
// are added to `sink`, so that the compiler keeps them.
VN_DECLARE_FOR_ISA(int64_t peak_float32(int64_t turns, float* sink))
#if VN_HAS_HALF
namespace avx512 {
int64_t peak_bfloat16(int64_t turns, float* sink);
int64_t peak_tiles(int64_t turns, float* sink);  // only where Isa::amx is supported
}  // namespace avx512
#endif

// Copies with streaming stores if the instruction set has them. Both addresses must be aligned to 64 bytes, and
// `floats` must be a multiple of 16.
VN_DECLARE_FOR_ISA(void peak_copy(const float* from, float* to, int64_t floats))

}  // namespace voronerf
