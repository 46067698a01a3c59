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
#error "define VN_HALF: 0 for float32 operands, 1 for a pair of bfloat16 instead of each float"
#endif

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kPanel = 64;  // columns of a packed panel of B

// The step along k: one product, or with bfloat16 operands the two of a pair.
VN_INLINE F32 multiply_add(F32 a, F32 b, F32 sum) {
#if VN_HALF
  return _mm512_dpbf16_ps(sum, (__m512bh)a, (__m512bh)b);
#else
  return fma(a, b, sum);
#endif
}

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
  // bfloat16 operands, columns a multiple of 32, finish none or relu: C as pairs as well, [rows][pairs_stride], and c
  // may be null.
  float* pairs;
  int64_t pairs_stride;
};

// A row to start from: nothing.
alignas(64) constexpr float kZeros[kPanel] = {};

// Rows of a block that fill the registers.
template <int V>
constexpr int block_rows() {
  return kLanes < 16 ? 6 : V == 4 ? 6 : V == 3 ? 8 : 12;
}

// Not inlined: among the caller's variables its pointers go to the stack, and the inner loop reloads them.
template <int R, int V, bool Transposed>
__attribute__((noinline)) void block(const Product& p, int64_t row, int64_t column) {
  F32 sum[R][V];
  for (int r = 0; r < R; ++r) {
    for (int v = 0; v < V; ++v) sum[r][v] = load(p.start + (row + r) * p.start_stride + column + v * kLanes);
  }
  const float* b = p.b + column;
  const int64_t b_stride = p.b_stride;
  const Source* source = p.sources;
  const Source* const end = source + p.count;
  // There is at least one source, and none is empty: loops that test at their end keep the sums in registers.
  do {
    const int64_t stride = source->stride;
    int64_t depth = source->depth;
    if (Transposed) {
      const float* a = source->data + row;
      do {
        F32 w[V];
        for (int v = 0; v < V; ++v) w[v] = load(b + v * kLanes);
        for (int r = 0; r < R; ++r) {
          const F32 x = splat(a[r]);
          for (int v = 0; v < V; ++v) sum[r][v] = multiply_add(x, w[v], sum[r][v]);
        }
        a += stride;
        b += b_stride;
      } while (--depth > 0);
    } else {
      const float* a[(R + 3) / 4];
      for (int g = 0; g < (R + 3) / 4; ++g) a[g] = source->data + (row + 4 * g) * stride;
      do {
        F32 w[V];
        for (int v = 0; v < V; ++v) w[v] = load(b + v * kLanes);
        for (int r = 0; r < R; ++r) {
          const F32 x = splat(a[r / 4][(r % 4) * stride]);
          for (int v = 0; v < V; ++v) sum[r][v] = multiply_add(x, w[v], sum[r][v]);
        }
        for (int g = 0; g < (R + 3) / 4; ++g) ++a[g];
        b += b_stride;
      } while (--depth > 0);
    }
  } while (++source != end);
  // Every way to finish stores by itself: merging them would send the sums through the stack. Comparisons are written
  // so that NaN passes, as in torch; a slope selects, since 0 times an infinite gradient would be NaN.
  const F32 zero = splat(0.0f);
  const int64_t c_stride = p.c_stride;
  float* const c = p.c == nullptr ? nullptr : p.c + row * c_stride + column;
#if VN_HALF
  if (V % 2 == 0 && p.pairs != nullptr) {
    const F32 lowest = p.finish == Finish::relu ? zero : splat(-__builtin_huge_valf());
    const int64_t pairs_stride = p.pairs_stride;
    float* const pairs = p.pairs + row * pairs_stride + column / 2;
    for (int r = 0; r < R; ++r) {
      for (int v = 0; v + 1 < V; v += 2) {
        const F32 low = sum[r][v] < lowest ? lowest : sum[r][v];
        const F32 high = sum[r][v + 1] < lowest ? lowest : sum[r][v + 1];
        store(pairs + r * pairs_stride + v * kLanes / 2, joined(low, high));
        if (c != nullptr) {
          store(c + r * c_stride + v * kLanes, low);
          store(c + r * c_stride + (v + 1) * kLanes, high);
        }
      }
    }
    return;
  }
#endif
  if (p.finish == Finish::none) {
    for (int r = 0; r < R; ++r) {
      for (int v = 0; v < V; ++v) store(c + r * c_stride + v * kLanes, sum[r][v]);
    }
  } else if (p.finish == Finish::relu) {
    for (int r = 0; r < R; ++r) {
      for (int v = 0; v < V; ++v) store(c + r * c_stride + v * kLanes, sum[r][v] < zero ? zero : sum[r][v]);
    }
  } else {
    const float* const slope = p.slope + row * c_stride + column;
    for (int r = 0; r < R; ++r) {
      for (int v = 0; v < V; ++v) {
        const int64_t at = r * c_stride + v * kLanes;
        store(c + at, load(slope + at) <= zero ? zero : sum[r][v]);
      }
    }
  }
}

template <int R, int V, bool Transposed>
VN_INLINE void rest(const Product& p, int64_t rows, int64_t row, int64_t column) {
  if constexpr (R > 0) {
    if (rows == R) {
      block<R, V, Transposed>(p, row, column);
    } else {
      rest<R - 1, V, Transposed>(p, rows, row, column);
    }
  }
}

template <int V, bool Transposed>
void strip(const Product& p, int64_t rows, int64_t column) {
  constexpr int kRows = block_rows<V>();
  int64_t row = 0;
  for (; row + kRows <= rows; row += kRows) block<kRows, V, Transposed>(p, row, column);
  rest<kRows - 1, V, Transposed>(p, rows - row, row, column);
}

// C [rows][columns], columns a multiple of 16 and at most kPanel.
template <bool Transposed>
void multiply(const Product& p, int64_t rows, int64_t columns) {
#if VN_ISA == 2
  switch (columns / kLanes) {
    case 4:
      return strip<4, Transposed>(p, rows, 0);
    case 3:
      return strip<3, Transposed>(p, rows, 0);
    case 2:
      return strip<2, Transposed>(p, rows, 0);
    default:
      return strip<1, Transposed>(p, rows, 0);
  }
#else
  constexpr int kVectors = kRegisters / 8;
  for (int64_t column = 0; column < columns; column += kVectors * kLanes) strip<kVectors, Transposed>(p, rows, column);
#endif
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
