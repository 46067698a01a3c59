// Products of floats, compiled once per instruction set.
#define VN_HALF 0
#include "network/cpu/gemm_blocks.h"
