// The encodings without parameters: DO(name, kernel), a row each. Python knows them by their names
// (ENCODINGS in voronerf/ops/_core/encodings.py). A kernel is of
//
//   ByRow<Formula>      a formula of one row: of a vector of rows on the CPU, of one row of a thread on CUDA
//   Octaves<kBlurred>   sines and cosines, of a table that is packed; kBlurred: by the variances beside x
//
// in by_row_tile.h and frequency_encode_tile.h on the CPU; on CUDA in program_cuda_encoding.h, and in encode.cu for the
// ops that are encodings.
//
// A formula is a struct in a header of its own, in F32 and the words of network/functions.h: it is there where they are
// (VN_WORDS), on both devices; who wants the names alone has none. of(i) is a column of x, g(c) the gradient to a
// column of its encoding. kMost: columns that it has at most.
//
//   values(of, columns of x, size, put)        put(c, value) for each column of the encoding
//   gradient(of, columns of x, size, g, put)   put(i, value) for each column of x
#define VN_ENCODINGS(DO)        \
  DO(frequency, Octaves<false>) \
  DO(integrated, Octaves<true>) \
  DO(spherical, ByRow<SphericalHarmonics>)

#ifdef VN_WORDS
#include "encoding/spherical_harmonics_math.h"
#endif
