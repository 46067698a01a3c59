// Unaligned vector loads and stores.
#pragma once

#include "common/simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

VN_INLINE F32 load(const float* from) {
  F32 a;
  __builtin_memcpy(&a, from, sizeof a);
  return a;
}

VN_INLINE void store(float* to, F32 a) { __builtin_memcpy(to, &a, sizeof a); }

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
