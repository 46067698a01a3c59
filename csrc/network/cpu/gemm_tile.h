// Small dense products on tiles that stay in cache: C[r][:] = init + sum_k A(r, k) B[k][:], the outputs in vector
// lanes.
//
// A block of R rows by V vectors lives in registers, its A values are broadcast from memory: with AVX-512 6 x 64, 8 x
// 48, 12 x 32 and 12 x 16 outputs, with NEON 6 x 16, with 16 registers 6 x 2 vectors. That is 1.7 to 2.4 multiply-adds
// a load, so the multiply-add units are the limit, not the cache. All three products of a layer have this form:
//
//   forward          rows are samples, k the inputs,  A = activations [rows][k],  B = packed weights [k][outputs]
//   input gradient   rows are samples, k the outputs, A = gradients [rows][k],    B = weights [k][inputs]
//   weight gradient  rows are inputs,  k the samples, A = activations [k][rows],  B = gradients [k][outputs]
//
// A concatenation is a list of sources, walked one after the other with the same accumulators. What is left of the rows
// runs in a block of exactly its size: nothing outside `rows` is read or written. Columns come in whole blocks of 16;
// B, C and `start` must be padded to that.
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

// Columns of a packed panel of B, which a column of blocks reads in a straight line: 16 of 64 would lie in a quarter of
// the sets of the first-level cache, where C's columns are too.
constexpr int64_t kPanel = VN_ISA == 2 || VN_HALF == 2 ? 64 : 16;

// One source of a concatenated A: `depth` values of k, in rows of `stride` floats.
struct Source {
  const float* data;
  int64_t stride;
  int64_t depth;
};

enum class Finish { none, relu, relu_slope };

struct Product {
  const Source* sources;
  int64_t count;
  const float* b;  // [sum of depths][b_stride]
  int64_t b_stride;
  const float* start;  // what to add to: rows of start_stride floats; C itself to accumulate, stride 0 for a bias
  int64_t start_stride;
  float* c;
  int64_t c_stride;
  Finish finish;
  const float* slope;  // relu_slope: C is 0 where slope <= 0, [rows][c_stride]
  // bfloat16 operands: C as pairs as well, [rows][pairs_stride], and c may be null; but in tile registers for columns
  // that are a multiple of 32, and no slope.
  float* pairs;
  int64_t pairs_stride;
  bool slope_in_pairs;  // in tile registers: [rows][pairs_stride]
  // In tile registers, of products in parts: what rounding has left of A, B and C lies so many floats behind their
  // pairs. 0: it does not count.
  int64_t a_left, b_left, pairs_left;
};

// A row to start from: nothing.
alignas(64) constexpr float kZeros[kPanel] = {};

#if VN_HALF < 2
// C [rows][columns], columns a multiple of 16 and at most kPanel; compiled once for all who multiply (gemm_blocks.h).
template <bool Transposed>
void multiply(const Product& p, int64_t rows, int64_t columns);
#endif

#if VN_HALF
}
#endif

#if VN_HALF < 2
namespace {

// The step along k: one product, or with bfloat16 operands the two of a pair.
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
