// frequency_encode and integrated_encode with their gradients: x [n,d] -> [n, width], [x, sin x, cos x, sin 2x, cos 2x,
// ...] in blocks of d, the input left out or not; with variances [n,d], each value is multiplied by exp(-4^l variance /
// 2). As in voronerf/ops/frequency_encode and integrated_encode. n, d and octaves may be 0.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

struct Encoding {
  const float* x;          // [n,d]
  const float* variances;  // [n,3], of the integrated encoding (d = 3, no input); null for the other
  int64_t n, d, octaves;
  bool include_input;
  int64_t width;  // of a row of the result
};

// Floats of workspace that a call needs.
int64_t encode_workspace(int64_t d, int64_t octaves, int threads);

void encode_cpu(const Encoding& in, float* out, float* workspace, Isa isa, int threads);

// gradient [n, width] -> grad_x [n,d], grad_variances [n,3] (null without variances).
void encode_backward_cpu(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                         float* workspace, Isa isa, int threads);

void encode_cuda(const Encoding& in, float* out, void* stream);
void encode_backward_cuda(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          void* stream);

// Rows in cache at a time, and floats of a row of the encoding there.
constexpr int64_t kEncodeRows = 32;
constexpr int64_t kEncodeLanes = 16;  // the widest vector

// Rows `begin` to `end` on the calling thread.
VN_DECLARE_FOR_ISA(void encode_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin,
                                    int64_t end))
VN_DECLARE_FOR_ISA(void encode_rows_backward(const Encoding& in, const float* gradient, float* grad_x,
                                             float* grad_variances, float* workspace, int64_t stride, int64_t begin,
                                             int64_t end))

}  // namespace voronerf
