// Products of floats, once for each instruction set.
#define VN_HALF 0
#include "network/cpu/gemm_blocks.h"
