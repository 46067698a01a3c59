// The kernels of composite, once for each instruction set: one ray with samples [begin, end). The gradient of the
// background is left to the caller; `left` is the transmittance of each ray.
#pragma once

#include "rays/composite.h"

namespace voronerf {

VN_DECLARE_FOR_ISA(void composite_ray(const CompositeInputs& in, const CompositeOutputs& out, int64_t ray,
                                      int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(void composite_ray_backward(const CompositeInputs& in, const CompositeGradients& gradients,
                                               int64_t ray, int64_t begin, int64_t end))

}  // namespace voronerf
