// Products of pairs of bfloat16; see program_half_isa.cpp.
#include "common/isa.h"

#if VN_ISA == 2 && VN_HAS_HALF
#pragma GCC target("avx512bf16")

#define VN_HALF 1
#include "network/cpu/gemm_blocks.h"

#endif
