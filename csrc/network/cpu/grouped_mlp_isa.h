// The kernels of grouped_mlp, once for each instruction set (grouped_mlp_isa.cpp).
#pragma once

#include "common/isa.h"
#include "network/cpu/grouped_mlp_plan.h"

namespace voronerf {

// Fills the encoding tables of a workspace; once for each thread and call.
VN_DECLARE_FOR_ISA(void mlp_prepare(const MlpPlan& plan, float* workspace))

// Packs a cell's weights into a workspace.
VN_DECLARE_FOR_ISA(void mlp_pack(const MlpPlan& plan, const MlpData& data, int64_t cell, float* workspace))

// Rows [begin, end) of the cell, which is packed, through the network.
VN_DECLARE_FOR_ISA(void mlp_forward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                                    float* workspace))

// Their gradients; those of the parameters fill `partial`.
VN_DECLARE_FOR_ISA(void mlp_backward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                                     float* workspace, float* partial))

// The same with bfloat16 products.
#if VN_HAS_HALF
namespace avx512 {
void mlp_half_pack(const MlpPlan& plan, const MlpData& data, int64_t cell, float* workspace);
void mlp_half_forward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                      float* workspace);
void mlp_half_backward(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t begin, int64_t end,
                       float* workspace, float* partial);
}  // namespace avx512
#endif

// Gradients of a cell's layer: the sum of `count` partials in their order.
VN_DECLARE_FOR_ISA(void mlp_reduce(const MlpPlan& plan, const MlpData& data, int64_t cell, int64_t layer,
                                   float* partials, int64_t count))

}  // namespace voronerf
