// The kernels of grouped_mlp with bfloat16 products: AVX-512 with its bfloat16 dot product, which multiplies pairs and
// adds to float32 at twice the rate of float32's multiply-add. Values, slopes, sums and gradients stay float32 in the
// tile; what enters a product is rounded to bfloat16 on the way (bfloat16_tile.h).
#include "network/cpu/grouped_mlp_isa.h"

#if VN_ISA == 2 && VN_HAS_HALF
#pragma GCC target("avx512bf16")

#define VN_HALF 1
#include "network/cpu/grouped_mlp_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void mlp_half_pack(const MlpPlan& plan, const MlpData& data, int64_t cell, float* workspace) {
  pack_cell(plan, data, cell, workspace);
}

void mlp_half_forward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                      float* workspace) {
  run_forward(plan, data, cell, begin, end, workspace);
}

void mlp_half_backward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                       float* workspace, float* partial) {
  run_backward(plan, data, cell, begin, end, workspace, partial);
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf

#endif
