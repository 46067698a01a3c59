// The CPU kernels of composite, compiled once per instruction set. Each call handles one ray with samples [begin, end).
// The caller computes the gradient of the background from `left`, the transmittance of each ray.
#pragma once

#include "rays/composite.h"

namespace voronerf {

VN_DECLARE_FOR_ISA(void composite_ray(const CompositeInputs& in, const CompositeOutputs& out, int64_t ray,
                                      int64_t begin, int64_t end))
VN_DECLARE_FOR_ISA(void composite_ray_backward(const CompositeInputs& in, const CompositeGradients& gradients,
                                               int64_t ray, int64_t begin, int64_t end))

}  // namespace voronerf
