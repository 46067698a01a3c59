// spherical_harmonics with its gradient: directions [n,3] -> [n, degree^2], degree 1 to 4. As in
// voronerf/ops/spherical_harmonics/reference.py. n may be 0.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

void spherical_harmonics_cpu(const float* directions, float* out, int64_t n, int64_t degree, Isa isa, int threads);

// gradient [n, degree^2] -> grad_directions [n,3].
void spherical_harmonics_backward_cpu(const float* directions, const float* gradient, float* grad_directions, int64_t n,
                                      int64_t degree, Isa isa, int threads);

void spherical_harmonics_cuda(const float* directions, float* out, int64_t n, int64_t degree, void* stream);
void spherical_harmonics_backward_cuda(const float* directions, const float* gradient, float* grad_directions,
                                       int64_t n, int64_t degree, void* stream);

// Of n rows, on the calling thread.
VN_DECLARE_FOR_ISA(void harmonics_rows(const float* directions, float* out, int64_t n, int64_t degree))
VN_DECLARE_FOR_ISA(void harmonics_rows_backward(const float* directions, const float* gradient, float* grad_directions,
                                                int64_t n, int64_t degree))

}  // namespace voronerf
