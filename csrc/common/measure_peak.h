// The peak arithmetic and copy rates of this machine, for benchmarks/. The operands of the arithmetic never leave
// registers, and the copied memory does not fit in any cache.
#pragma once

#include "common/isa.h"

namespace voronerf {

enum class Peak : int { float32 = 0, bfloat16, copy };

// Returns the floating-point operations per second of multiply-adds (two operations each; a bfloat16 dot product has
// four per lane), or the bytes per second, read and written, of a copy. The result is the best of several bursts of one
// or two milliseconds, 0.1 s in total. A copy uses cached or streaming stores, whichever are faster. Throws
// std::invalid_argument if `isa` does not support `kind`.
double measure_peak(Peak kind, Isa isa, int threads);

// Returns the speed-up of bfloat16 products over float32 products on one thread, measured in half a millisecond; 0 if
// the processor or the build has no bfloat16 products. It is 2 on AMD's Zen 4 and 5. It is 0.5 on Intel's Emerald
// Rapids, whose fast bfloat16 products use tile registers (Isa::amx).
double bfloat16_gain();

}  // namespace voronerf
