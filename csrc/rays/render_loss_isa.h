// The CPU kernels of render_loss, compiled once per instruction set. The caller computes the loss from the errors.
#pragma once

#include "rays/render_loss.h"

namespace voronerf {

constexpr int64_t kRenderLossRays = 64;  // the maximum number of rays in a call

// Either all rays [begin, end) have a target, or none of them has.
VN_DECLARE_FOR_ISA(void render_loss_rays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin,
                                         int64_t end))
// Handles samples without a ray: computes their density, and zeros their weights and gradient.
VN_DECLARE_FOR_ISA(void render_loss_strays(const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin,
                                           int64_t end))

}  // namespace voronerf
