// The encodings without parameters (encodings.h) and their gradients: x [n,d] -> [n, width], by the kernels of rows
// that programs use. As in ENCODINGS of voronerf/ops/_core/encodings.py. n, d and width may be 0.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "network/program_code.h"

namespace voronerf {

struct Encoding {
  ProgramEncoding encoding;  // all but hash
  int64_t n;
  int32_t width;           // of a row of the result
  const float* x;          // [n,d]
  const float* variances;  // [n,d] of the integrated encoding; null for others
  int32_t d, size;         // size: octaves, or the degree of spherical harmonics
  bool include_input;      // of sines and cosines: whether x itself comes first
};

void encode_cpu(const Encoding& in, float* out, Isa isa, int threads);

// gradient [n, width] -> grad_x [n,d], grad_variances [n,d]; either may be null.
void encode_backward_cpu(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances, Isa isa,
                         int threads);

void encode_cuda(const Encoding& in, float* out, void* stream);
void encode_backward_cuda(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          void* stream);

constexpr int64_t kEncodeRows = 32;   // in cache at a time
constexpr int64_t kEncodeLanes = 16;  // the widest vector

// Rows `begin` to `end` on the calling thread. stride: floats of a row of the encoding in the workspace.
VN_DECLARE_FOR_ISA(void encode_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin,
                                    int64_t end))
VN_DECLARE_FOR_ISA(void encode_rows_backward(const Encoding& in, const float* gradient, float* grad_x,
                                             float* grad_variances, float* workspace, int64_t stride, int64_t begin,
                                             int64_t end))

}  // namespace voronerf
