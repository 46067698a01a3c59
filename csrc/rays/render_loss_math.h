// The loss of a ray, for the CPU and for CUDA: its squared error e, summed over the channels; or, with a scale s > 0,
// 2 s (sqrt(e + s^2) - s), which is e where e is small beside s^2, and 2 s sqrt(e) where it is large: the loss of
// Charbonnier et al. 1994, written without the digits that the difference would cost.
#pragma once

#include "common/hd.h"

namespace voronerf {

// No header of the standard's, whose inline functions files of several instruction sets would share.
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

// Its derivative to the error.
VN_HD float ray_loss_slope(float error, float robust) {
  return robust > 0.0f ? robust / root_of(error + robust * robust) : 1.0f;
}

}  // namespace voronerf
