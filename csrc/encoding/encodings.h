// The encodings without parameters: one DO(name, kernel) for each. Python uses the same names (ENCODINGS in
// voronerf/ops/_core/encodings.py). The kernels:
//
//   ByRow<Formula>      a formula for one row; the CPU evaluates it for a vector of rows, a CUDA thread for one row
//   Octaves<kBlurred>   sines and cosines; kBlurred: damped by the variances of x
//
// The CPU kernels are in by_row_tile.h and frequency_encode_tile.h. The CUDA kernels are in program_cuda_encoding.h for
// programs, and in encode.cu for the separate ops.
//
// A formula is a struct in its own header, written with F32 and the functions that network/functions.h requires, so
// that both devices share it. The header is included only if these functions are defined (VN_WORDS). of(i) is column i
// of x, g(c) the gradient with respect to column c of the encoding. kMost is the largest number of columns.
//
//   values(of, columns of x, size, put)        calls put(c, value) for each column of the encoding
//   gradient(of, columns of x, size, g, put)   calls put(i, value) for each column of x
#define VN_ENCODINGS(DO)        \
  DO(frequency, Octaves<false>) \
  DO(integrated, Octaves<true>) \
  DO(spherical, ByRow<SphericalHarmonics>)

#ifdef VN_WORDS
#include "encoding/spherical_harmonics_math.h"
#endif
