// The encodings without parameters (encodings.h) and their gradients: x [n,d] -> [n, width]. They agree with
// ENCODINGS in voronerf/ops/_core/encodings.py. On the CPU they use the row kernels of grouped programs
// (network/program.h). n, d and width may be 0.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "network/program_code.h"

namespace voronerf {

struct Encoding {
  ProgramEncoding encoding;  // any but hash
  int64_t n;
  int32_t width;           // columns of the result
  const float* x;          // [n,d]
  const float* variances;  // [n,d] for the integrated encoding, else null
  int32_t d, size;         // size: number of octaves, or degree of the spherical harmonics
  bool include_input;      // x itself precedes the sines and cosines
};

void encode_cpu(const Encoding& in, float* out, Isa isa, int threads);

// gradient [n, width] -> grad_x [n,d], grad_variances [n,d]; either may be null.
void encode_backward_cpu(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances, Isa isa,
                         int threads);

void encode_cuda(const Encoding& in, float* out, void* stream);
void encode_backward_cuda(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          void* stream);

constexpr int64_t kEncodeRows = 32;   // rows of a tile, which stays in cache
constexpr int64_t kEncodeLanes = 16;  // lanes of the widest vector

// Encodes rows `begin` to `end` on the calling thread. stride: floats between encoded rows in the workspace.
VN_DECLARE_FOR_ISA(void encode_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin,
                                    int64_t end))
VN_DECLARE_FOR_ISA(void encode_rows_backward(const Encoding& in, const float* gradient, float* grad_x,
                                             float* grad_variances, float* workspace, int64_t stride, int64_t begin,
                                             int64_t end))

}  // namespace voronerf
