// Small dense products on tiles that stay in cache: C[r][:] = init + sum_k A(r, k) B[k][:], with the outputs in vector
// lanes.
//
// A block of R rows by V vectors stays in registers, and values of A are broadcast from memory. A block has 6 x 64, 8 x
// 48, 12 x 32 or 12 x 16 outputs with AVX-512, 6 x 16 with NEON, and 6 x 2 vectors with 16 registers. That is 1.7 to
// 2.4 multiply-adds per load, so the multiply-add units are the limit, not the cache. All three products of a layer
// have this form:
//
//   forward          rows are samples, k the inputs,  A = activations [rows][k],  B = packed weights [k][outputs]
//   input gradient   rows are samples, k the outputs, A = gradients [rows][k],    B = weights [k][inputs]
//   weight gradient  rows are inputs,  k the samples, A = activations [k][rows],  B = gradients [k][outputs]
//
// A concatenated A is a list of sources, which are added to the same accumulators one after the other. The last rows
// run in a block with exactly as many rows, so nothing outside `rows` is read or written. The number of columns is a
// multiple of 16, and B, C and `start` must be padded to this number.
#pragma once

#include "common/memory_tile.h"
#include "common/simd.h"
#include "network/cpu/bfloat16_tile.h"

#ifndef VN_HALF
#error "define VN_HALF: 0 for float32 operands, 1 for a pair of bfloat16 instead of each float, 2 for tile registers"
#endif

namespace voronerf {
namespace VN_ISA_NAMESPACE {
#if VN_HALF == 1
inline namespace pairs {
#elif VN_HALF == 2
inline namespace tiles_of_pairs {
#endif

// The columns of a packed panel of B. Blocks read whole panels: if they read 16 of 64 columns, B would use only a
// quarter of the sets of the first-level cache, the same sets as the columns of C.
constexpr int64_t kPanel = VN_ISA == 2 || VN_HALF == 2 ? 64 : 16;

// One source of a concatenated A, with `depth` values of k in rows of `stride` floats.
struct LeftPart {
  const float* data;
  int64_t stride;
  int64_t depth;
};

enum class Finish { none, relu, relu_slope };

struct Product {
  const LeftPart* sources;
  int64_t count;
  const float* b;  // [sum of depths][b_stride]
  int64_t b_stride;
  const float* start;  // initial sums: rows of start_stride floats; C itself to accumulate, stride 0 for a bias
  int64_t start_stride;
  float* c;
  int64_t c_stride;
  Finish finish;
  const float* slope;  // relu_slope: C is 0 where slope <= 0, [rows][c_stride]
  // With bfloat16 operands, C is also stored as pairs, [rows][pairs_stride], and `c` may be null. Without tile
  // registers the columns must then be a multiple of 32, and `slope` must be null.
  float* pairs;
  int64_t pairs_stride;
  bool slope_in_pairs;  // in tile registers: slope is [rows][pairs_stride]
  // In tile registers, if each float is split into a bfloat16 number and its rounding remainder (ProgramLayout::parts):
  // the remainders of A, B and C follow their pairs at these distances in floats. 0: no remainders.
  int64_t a_left, b_left, pairs_left;
};

// A row of zeros as initial sums.
alignas(64) constexpr float kZeros[kPanel] = {};

#if VN_HALF < 2
// Computes C [rows][columns] with at most kPanel columns, a multiple of 16. It is compiled once per instruction set
// (gemm_blocks.h).
template <bool Transposed>
void multiply(const Product& p, int64_t rows, int64_t columns);
#endif

#if VN_HALF
}
#endif

#if VN_HALF < 2
namespace {

// Adds one product along k, or with bfloat16 operands the two products of a pair.
VN_INLINE F32 multiply_add(F32 a, F32 b, F32 sum) {
#if VN_HALF
  return _mm512_dpbf16_ps(sum, (__m512bh)a, (__m512bh)b);
#else
  return fma(a, b, sum);
#endif
}

}  // namespace
#endif
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
