// The products of gemm_tile.h in tile registers (tile_registers.h), 16 rows by 16 columns by 16 pairs at a time. All
// operands are pairs, and depths are padded with 0 to a multiple of 16 pairs.
//
// A block of 32 rows by 32 columns has four registers of sums, two of A and two of B. It needs as many loads as
// products, and a product takes twice as long as a load. The sums of a block are stored to memory in the first-level
// cache and finished (ReLU, rounding) while the products of the next block run. Otherwise instructions that wait for
// the sums would fill the processor's queue, and the next products could not enter it.
#pragma once

#include "network/cpu/gemm_tile.h"
#include "network/cpu/tile_registers.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
inline namespace tiles_of_pairs {
namespace {

constexpr int64_t kBlock = 2 * kTileRows, kStep = 16;  // rows and columns of a block, pairs per row of a register
constexpr int64_t kFloat = sizeof(float);

template <int N>
struct Register {
  static constexpr int kNumber = N;
};

// Shapes the registers for blocks of up to `rows` rows: 0 to 3 are sums, 4 and 5 are A, 6 and 7 are B.
VN_INLINE void shape_for(int64_t rows) {
  TileShapes shapes;
  for (int i = 0; i < 8; ++i) {
    const int64_t count = i > 5 ? kTileRows : rows - i % 2 * kTileRows;
    shapes.bytes[i] = kTileBytes;
    shapes.rows[i] = static_cast<uint8_t>(count > kTileRows ? kTileRows : count < 1 ? 1 : count);
  }
  shape_tiles(shapes);
}

// Blocks of row_step rows and column_step columns, in rows [row, row_end) and columns [column, column_end).
struct Blocks {
  int64_t row, row_end, row_step, column, column_end, column_step;
};
// A block whose sums are stored at `sums`, in rows of kBlock floats.
struct Block {
  int64_t row, column, rows;
  const float* sums;
};
enum class Slope { none, relu, floats, pairs };
enum class Pairs { none, rounded, parts };

// Returns the sum, or 0 in lanes whose slope is 0 or less.
VN_INLINE F32 by_slope(F32 slope, F32 sum) { return slope <= splat(0.0f) ? splat(0.0f) : sum; }

VN_INLINE F32 joined_by_slope(F32 slopes, F32 low, F32 high) {
#if VN_ISA == 2
  // As signed integers, the bits of a slope above 0 are above 0. As unsigned integers, the bits of negative NaN are
  // larger than the bits of any other number.
  const __m512i slope = (__m512i)slopes;
  const __mmask32 above = _mm512_cmpgt_epi16_mask(slope, _mm512_setzero_si512());
  const __mmask32 none = _mm512_cmpgt_epu16_mask(slope, _mm512_set1_epi16(static_cast<int16_t>(0xff80)));
  return (F32)_mm512_maskz_mov_epi16(above | none, (__m512i)joined(low, high));
#else
  return joined(by_slope(widened(slopes, 0), low), by_slope(widened(slopes, 1), high));
#endif
}

// Finishes rows [begin, end) of a block, two neighbouring vectors at a time. Pairs after the last column become zeros.
template <Slope S, bool kFloats, Pairs P, bool kWhole>
VN_INLINE void finish(const Product& p, const Block& block, int64_t begin, int64_t end) {
  constexpr bool kPairs = P != Pairs::none, kLeft = P == Pairs::parts;
  const int64_t columns = kWhole ? kBlock : kTileRows, c_stride = p.c_stride, pairs_stride = p.pairs_stride;
  const float* from = block.sums + begin * kBlock;
  float* c = kFloats ? p.c + (block.row + begin) * c_stride + block.column : nullptr;
  float* pairs = kPairs ? p.pairs + (block.row + begin) * pairs_stride + block.column / 2 : nullptr;
  const float* slope = S == Slope::floats  ? p.slope + (block.row + begin) * c_stride + block.column
                       : S == Slope::pairs ? p.slope + (block.row + begin) * pairs_stride + block.column / 2
                                           : nullptr;
  const F32 zero = splat(0.0f);
  for (int64_t row = begin; row < end; ++row, from += kBlock) {
    for (int64_t column = 0; column < kBlock; column += 2 * kLanes) {
      const bool both = kWhole || column + kLanes < columns;
      if (!kWhole && column >= columns) {
        if (kPairs) store(pairs + column / 2, zero);
        if (kLeft) store(pairs + p.pairs_left + column / 2, zero);
        continue;
      }
      F32 low = load(from + column), high = both ? load(from + column + kLanes) : zero;
      if (S == Slope::relu) {  // NaN passes
        low = max(zero, low);
        high = max(zero, high);
      } else if (S == Slope::floats) {
        low = by_slope(load(slope + column), low);
        if (both) high = by_slope(load(slope + column + kLanes), high);
      } else if (S == Slope::pairs) {
        const F32 values = load(slope + column / 2);
        if (kFloats || kLeft) {
          low = by_slope(widened(values, 0), low);
          high = by_slope(widened(values, 1), high);
        } else {
          store(pairs + column / 2, joined_by_slope(values, low, high));
          continue;
        }
      }
      if (kPairs) {
        const F32 rounded = joined(low, high);
        store(pairs + column / 2, rounded);
        if (kLeft) store(pairs + p.pairs_left + column / 2, left_of(low, high, rounded));
      }
      if (kFloats) store(c + column, low);
      if (kFloats && both) store(c + column + kLanes, high);
    }
    if (kFloats) c += c_stride;
    if (kPairs) pairs += pairs_stride;
    if (S != Slope::none && S != Slope::relu) slope += S == Slope::pairs ? pairs_stride : c_stride;
  }
}

// Computes blocks of R by C registers. While the products of a block's first step run, the sums of the previous block
// are stored: to C if there is nothing to finish, else to a buffer, which is finished during the products of the last
// step.
template <int R, int C, Slope S, bool kFloats, Pairs P>
__attribute__((noinline)) void multiply_blocks(const Product& p, const Blocks& blocks) {
  constexpr bool kFinish = S != Slope::none || P != Pairs::none;
  alignas(64) float memory[kBlock * kBlock];
  const LeftPart& source = *p.sources;
  const int64_t a_next = kTileRows * source.stride, a_stride = source.stride * kFloat;
  const int64_t b_step = kStep * p.b_stride, b_stride = p.b_stride * kFloat;
  const int64_t start_next = kTileRows * p.start_stride, start_stride = p.start_stride * kFloat;
  const int64_t to_row = kFinish ? kBlock : p.c_stride, to_next = kTileRows * to_row, to_stride = to_row * kFloat;
  const int64_t steps = (p.a_left > 0 ? 3 : 1) * source.depth / kStep;
  float* to = memory;
  bool has_previous = false;
  Block previous{0, 0, blocks.row_step, memory};
  const auto store = [&](auto q) {
    constexpr int kQ = decltype(q)::kNumber, kRow = kQ % 2, kColumn = kQ / 2;
    tile_store<kQ>(to + kRow * to_next + kColumn * kTileRows, to_stride);
  };
  const auto finish_quarter = [&](int64_t q) {
    if (kFinish && has_previous)
      finish<S, kFloats, P, C == 2>(p, previous, previous.rows * q / 4, previous.rows * (q + 1) / 4);
  };
  for (int64_t row = blocks.row; row < blocks.row_end; row += blocks.row_step) {
    for (int64_t column = blocks.column; column < blocks.column_end; column += blocks.column_step) {
      const float *a = source.data + row * source.stride, *b = p.b + column;
      const float* const start = p.start + row * p.start_stride + column;
      const auto begin = [&](auto q) {
        constexpr int kQ = decltype(q)::kNumber, kRow = kQ % 2, kColumn = kQ / 2;
        if (has_previous) store(q);
        tile_load<kQ>(start + kRow * start_next + kColumn * kTileRows, start_stride);
      };
      const auto products = [&](const auto& begins, const auto& then) {
        tile_load<6>(b, b_stride);
        tile_load<4>(a, a_stride);
        begins(Register<0>{});
        tile_products<0, 4, 6>();
        then(0);
        if constexpr (R > 1) {
          tile_load<5>(a + a_next, a_stride);
          begins(Register<1>{});
          tile_products<1, 5, 6>();
        }
        then(1);
        if constexpr (C > 1) {
          tile_load<7>(b + kTileRows, b_stride);
          begins(Register<2>{});
          tile_products<2, 4, 7>();
        }
        then(2);
        if constexpr (R > 1 && C > 1) {
          begins(Register<3>{});
          tile_products<3, 5, 7>();
        }
        then(3);
      };
      const auto nothing = [](auto) {};
      products(begin, nothing);
      for (int64_t step = 1, k = kStep; step < steps; ++step, k += kStep) {
        a += kStep;
        b += b_step;
        if (k == source.depth) {  // products in parts: high x low, then low x high
          const bool last = step + source.depth / kStep == steps;
          a = source.data + row * source.stride + (last ? p.a_left : 0);
          b = p.b + column + (last ? 0 : p.b_left);
          k = 0;
        }
        step + 1 < steps ? products(nothing, nothing) : products(nothing, finish_quarter);
      }
      for (int q = 0; steps == 1 && q < 4; ++q) finish_quarter(q);
      has_previous = true;
      previous.row = row;
      previous.column = column;
      if (!kFinish) to = p.c + row * p.c_stride + column;
    }
  }
  store(Register<0>{});
  if constexpr (R > 1) store(Register<1>{});
  if constexpr (C > 1) store(Register<2>{});
  if constexpr (R > 1 && C > 1) store(Register<3>{});
  if (kFinish) finish<S, kFloats, P, C == 2>(p, previous, 0, previous.rows);
}

template <Slope S, bool kFloats, Pairs P>
VN_INLINE void multiply_shapes(const Product& p, int64_t rows, int64_t columns) {
  const auto strip = [&](int64_t row, int64_t end, int64_t step) {
    const int64_t whole = columns / kBlock * kBlock;
    const Blocks wide{row, end, step, 0, whole, kBlock}, narrow{row, end, step, whole, columns, kTileRows};
    if (whole > 0) {
      step > kTileRows ? multiply_blocks<2, 2, S, kFloats, P>(p, wide) : multiply_blocks<1, 2, S, kFloats, P>(p, wide);
    }
    if (whole < columns) {
      step > kTileRows ? multiply_blocks<2, 1, S, kFloats, P>(p, narrow)
                       : multiply_blocks<1, 1, S, kFloats, P>(p, narrow);
    }
  };
  const int64_t whole = rows / kBlock * kBlock;
  if (whole > 0) strip(0, whole, kBlock);
  if (whole == rows) return;
  shape_for(rows - whole);
  strip(whole, rows, rows - whole);
  shape_for(kBlock);
}

template <Slope S>
VN_INLINE void multiply_to(const Product& p, int64_t rows, int64_t columns) {
  if (p.pairs == nullptr) return multiply_shapes<S, true, Pairs::none>(p, rows, columns);
  if (p.pairs_left == 0) {
    p.c == nullptr ? multiply_shapes<S, false, Pairs::rounded>(p, rows, columns)
                   : multiply_shapes<S, true, Pairs::rounded>(p, rows, columns);
  } else {
    p.c == nullptr ? multiply_shapes<S, false, Pairs::parts>(p, rows, columns)
                   : multiply_shapes<S, true, Pairs::parts>(p, rows, columns);
  }
}

}  // namespace

// Computes C [rows][columns], with columns a multiple of 16. The registers have the shapes of whole blocks on entry and
// on return.
static void multiply_tiles(const Product& p, int64_t rows, int64_t columns) {
  if (p.finish == Finish::none) {
    multiply_to<Slope::none>(p, rows, columns);
  } else if (p.finish == Finish::relu) {
    multiply_to<Slope::relu>(p, rows, columns);
  } else if (p.slope_in_pairs) {
    multiply_to<Slope::pairs>(p, rows, columns);
  } else {
    multiply_to<Slope::floats>(p, rows, columns);
  }
}

}  // namespace tiles_of_pairs
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
