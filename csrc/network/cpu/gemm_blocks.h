// The blocks of gemm_tile.h, for gemm_isa.cpp and gemm_half_isa.cpp.
#pragma once

#include "network/cpu/gemm_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Returns the number of rows with which a block fills the registers.
template <int V>
constexpr int block_rows() {
  return kLanes < 16 ? 6 : V == 4 ? 6 : V == 3 ? 8 : 12;
}

// Computes a block of R rows by V vectors. It is not inlined, since inlining would spill its pointers to the stack and
// reload them in the inner loop.
template <int R, int V, bool Transposed>
__attribute__((noinline)) void block(const Product& p, int64_t row, int64_t column) {
  F32 sum[R][V];
  for (int r = 0; r < R; ++r) {
    for (int v = 0; v < V; ++v) sum[r][v] = load(p.start + (row + r) * p.start_stride + column + v * kLanes);
  }
  const float* b = p.b + column;
  const int64_t b_stride = p.b_stride;
  const LeftPart* source = p.sources;
  const LeftPart* const end = source + p.count;
  // There is at least one source and none is empty, so do-while loops are possible: they keep the sums in registers.
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
  // Each kind of `finish` has its own stores: shared stores would spill the sums to the stack. The order of the
  // operands of max lets NaN pass, as in torch. A slope selects instead of multiplying, since 0 times an infinite
  // gradient would be NaN.
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
        const F32 low = max(lowest, sum[r][v]);
        const F32 high = max(lowest, sum[r][v + 1]);
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
      for (int v = 0; v < V; ++v) store(c + r * c_stride + v * kLanes, max(zero, sum[r][v]));
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

}  // namespace

#if VN_HALF
inline namespace pairs {
#endif

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

template void multiply<false>(const Product&, int64_t, int64_t);
template void multiply<true>(const Product&, int64_t, int64_t);

#if VN_HALF
}
#endif

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
