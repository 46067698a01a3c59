// The kernels of grouped_linear with bfloat16 products; see grouped_mlp_half_isa.cpp.
#include "network/cpu/grouped_linear_isa.h"

#if VN_ISA == 2 && VN_HAS_HALF
#pragma GCC target("avx512bf16")

#define VN_HALF 1
#include "network/cpu/grouped_linear_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void linear_half_pack(const LinearCall& call, int64_t cell, float* workspace) { pack_linear(call, cell, workspace); }

void linear_half_forward(const LinearCall& call, int64_t begin, int64_t end, float* workspace) {
  run_linear_forward(call, begin, end, workspace);
}

void linear_half_backward(const LinearCall& call, int64_t begin, int64_t end, float* workspace, float* partial) {
  run_linear_backward(call, begin, end, workspace, partial);
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#endif
