// The kernels of render_loss, once for each instruction set. The loss itself, the mean of the errors, is left to the
// caller.
#pragma once

#include "rays/render_loss.h"

namespace voronerf {

constexpr int64_t kRenderLossRays = 64;  // of a call, at most

// All rays [begin, end) have a colour to learn, or none of them has.
VN_DECLARE_FOR_ISA(void render_loss_rays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin,
                                         int64_t end))
VN_DECLARE_FOR_ISA(void run_sums_block(const RenderLossInputs& in, const float* depths, const int32_t* ray_index,
                                       float* density, float* sums, int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(void run_gradients_block(const RenderLossInputs& in, const float* answers, float* gradient,
                                            float* weights, float* importance, int64_t begin, int64_t end))
// Samples of no ray: only their density is of interest.
VN_DECLARE_FOR_ISA(void render_loss_strays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin,
                                           int64_t end))

}  // namespace voronerf
