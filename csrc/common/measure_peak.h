// The limits of this machine's cores and memory, for benchmarks/: operands that never leave registers,
// and a copy of memory that fits no cache.
#pragma once

#include "common/isa.h"

namespace voronerf {

enum class Peak : int { float32 = 0, bfloat16, copy };

// Floating-point operations a second of multiply-adds (two each; of bfloat16 dot products, four a lane), or bytes a
// second, read and written, of a copy; the best of some bursts of a millisecond or two, 0.1 s in all. A copy is the
// faster of cached and streaming stores, whatever the instruction set. Throws std::invalid_argument where `isa` has no
// such instruction.
double measure_peak(Peak kind, Isa isa, int threads);

// How many times as many operations a second one thread makes in bfloat16 products as in float32 ones, in half a
// millisecond; 0 where the processor or the build has none. It is 2 on AMD's Zen 4 and 5 and 0.5 on Intel's Emerald
// Rapids, whose fast products are those in tile registers (Isa::amx).
double bfloat16_gain();

}  // namespace voronerf
