// The loss of a ray, for the CPU and for CUDA: its squared error e, summed over the channels; or, with a scale s > 0, 2
// s (sqrt(e + s^2) - s). This is about e for e much below s^2, and about 2 s sqrt(e) for large e: the loss of
// Charbonnier et al. 1994, in a form without cancellation.
#pragma once

#include "common/hd.h"

namespace voronerf {

// Uses no standard header, because files compiled for different instruction sets would share the header's inline
// functions.
VN_HD float root_of(float x) {
#ifdef __CUDA_ARCH__
  return sqrtf(x);
#else
  return __builtin_sqrtf(x);
#endif
}

VN_HD float ray_loss(float error, float robust) {
  if (!(robust > 0.0f)) return error;
  return 2.0f * robust * error / (root_of(error + robust * robust) + robust);
}

// Returns the derivative of ray_loss with respect to the error.
VN_HD float ray_loss_slope(float error, float robust) {
  return robust > 0.0f ? robust / root_of(error + robust * robust) : 1.0f;
}

}  // namespace voronerf
