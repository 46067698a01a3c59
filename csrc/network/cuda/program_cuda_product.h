// Products of a block on CUDA. TensorSteps and FloatSteps make the steps of a program that multiply, with values of a
// tile as they lie in its slots and weights as program_prepare_kernel has packed them: nothing passes through shared
// memory but values, and no thread waits for another.
//
// Tensor cores: 8 warps, kDown by rows and 8 / kDown by columns; a warp has kTall times 16 rows and kDown tiles of 8
// columns. Weights lie in the order of fragments: for each chunk of the depth and each tile of 8 columns the 16 bytes
// of a lane, so that a warp reads 512 bytes in a row. 16-bit values lie in words of two columns, whose rows are 4 words
// longer than a multiple of 16: the 8 rows of a matrix that ldmatrix reads are in different banks.
//
// float32: a thread has kDown rows by four columns; weights lie as [depth][columns].
#pragma once

#include "common/cuda_wrappers.h"
#include "common/index_maps.h"
#include "network/cuda/program_cuda_tile.h"

namespace voronerf {

// Weights, packed -------------------------------------------------------------------------------------------------

// Of a matrix as a product reads it: what there is at a depth and an output.
struct PackedMatrix {
  const float* data;
  int by_depth, by_output, depth, outputs;
  __device__ __forceinline__ float at(int k, int n) const {
    return k < depth && n < outputs ? data[k * by_depth + n * by_output] : 0.0f;
  }
};

// Word `word` of the fragments: lane 4 g + m of a tile has steps m of column g.
template <typename Numbers>
__device__ __forceinline__ uint32_t packed_word(const PackedMatrix& matrix, int word) {
  const int tiles = padded(matrix.outputs, kProgramOutputs) / 8;
  const int part = word % 4, lane = word / 4 % 32, rest = word / 128, chunk = rest / tiles, tile = rest % tiles;
  return Numbers::right(matrix, Numbers::kChunk * chunk, part, lane % 4, 8 * tile + lane / 4);
}

// Operands --------------------------------------------------------------------------------------------------------

// A value in its slot: words of two 16-bit numbers where there are such, else floats.
struct ProductValue {
  const float* floats;
  const uint32_t* words;
  bool has_words;
  int stride;   // of either
  int columns;  // behind which floats are anything, and words are 0 up to the next multiple of 32
  __device__ __forceinline__ float at(int row, int column) const {
    return column < columns ? floats[row * stride + column] : 0.0f;
  }
};
template <typename Tile>
__device__ __forceinline__ ProductValue product_value(const Tile& tile, const CudaValue& value, bool words) {
  const float* at = tile.slot(value.slot) + value.start;
  return {at, reinterpret_cast<const uint32_t*>(at), words, value.stride, value.columns};
}

// What a lane has of a left operand [16][32] of 16 bits: two fragments of mma.m16n8k16; of tf32 [16][16].
struct LeftFragments {
  uint32_t words[2][4];
};

template <bool kBfloat16>
struct HalfNumbers {
  static constexpr int kChunk = 32;
  static constexpr bool kHalves = true, kCuts = !kBfloat16;  // numbers beyond the largest
  static constexpr int kResident = kCuts ? 2 : 3;            // blocks for whose threads there are registers enough

  static __device__ __forceinline__ uint32_t pair(float x, float y) { return pack_halves<kBfloat16>(x, y); }
  static __device__ __forceinline__ uint32_t relu(uint32_t word) { return relu_halves<kBfloat16>(word); }
  static __device__ __forceinline__ uint32_t right(const PackedMatrix& matrix, int k, int part, int member, int n) {
    const int at = k + 8 * part + 2 * member;
    // Weights beyond the largest float16 are cut off.
    const uint32_t word = pair(matrix.at(at, n), matrix.at(at + 1, n));
    return kCuts ? clamp_halves(word) : word;
  }

  // Rows from `row` on, steps from k on. Infinities that enter a product of float16 are cut off where `cut` says so.
  template <bool kShared, bool kWords>
  static __device__ __forceinline__ LeftFragments left(const ProductValue& x, int row, int k, bool cut, int lane) {
    LeftFragments found;
    if constexpr (kWords) {
#pragma unroll
      for (int s = 0; s < 2; ++s)
        load_matrices<kShared>(found.words[s], x.words + row * x.stride + k / 2 + 8 * s, x.stride, lane);
    } else {
      const int group = lane / 4, member = lane % 4;
#pragma unroll
      for (int i = 0; i < 8; ++i) {
        const int at = k + 16 * (i / 4) + 8 * (i % 4 / 2) + 2 * member, of = row + group + 8 * (i % 2);
        found.words[i / 4][i % 4] = pair(x.at(of, at), x.at(of, at + 1));
      }
    }
    if (kCuts && cut) clamp(found);
    return found;
  }
  static __device__ __forceinline__ void multiply(float (&sums)[4], const LeftFragments& left, const uint4& right) {
    const uint32_t first[2] = {right.x, right.y}, second[2] = {right.z, right.w};
    multiply_halves<kBfloat16>(sums, left.words[0], first);
    multiply_halves<kBfloat16>(sums, left.words[1], second);
  }

  // For sums over rows: columns from i on as the rows of a left operand, over the 16 rows from `row` on.
  static constexpr int kRows = 16;
  template <bool kShared, bool kWords>
  static __device__ __forceinline__ void turned_left(uint32_t (&words)[4], const ProductValue& a, int i, int row,
                                                     int rows, int lane) {
    if (kWords || a.has_words) {
      load_turned<kShared, true>(words, a.words + row * a.stride + i / 2, a.stride, lane);
    } else {
#pragma unroll
      for (int j = 0; j < 4; ++j) words[j] = turned_pair(a, row + 8 * (j / 2), i + 8 * (j % 2), rows, lane);
    }
  }
  // Columns from j on, two tiles of 8, as right operands.
  template <bool kShared, bool kWords>
  static __device__ __forceinline__ void turned_right(uint32_t (&words)[2][2], const ProductValue& b, int j, int row,
                                                      int rows, bool cut, int lane) {
    if (kWords || b.has_words) {
      uint32_t four[4];
      load_turned<kShared, false>(four, b.words + row * b.stride + j / 2, b.stride, lane);
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = four[i];
    } else {
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = turned_pair(b, row + 8 * (i % 2), j + 8 * (i / 2), rows, lane);
    }
    if (kCuts && cut) {
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = clamp_halves(words[i / 2][i % 2]);
    }
  }
  static __device__ __forceinline__ void multiply_turned(float (&sums)[4], const uint32_t (&left)[4],
                                                         const uint32_t (&right)[2]) {
    multiply_halves<kBfloat16>(sums, left, right);
  }

 private:
  static __device__ __forceinline__ void clamp(LeftFragments& found) {
#pragma unroll
    for (int i = 0; i < 8; ++i) found.words[i / 4][i % 4] = clamp_halves(found.words[i / 4][i % 4]);
  }
  // Two rows of a lane's column.
  static __device__ __forceinline__ uint32_t turned_pair(const ProductValue& a, int row, int column, int rows,
                                                         int lane) {
    const int at = row + 2 * (lane % 4), of = column + lane / 4;
    return pair(at < rows ? a.at(at, of) : 0.0f, at + 1 < rows ? a.at(at + 1, of) : 0.0f);
  }
};

struct Tf32Numbers {
  static constexpr int kChunk = 16;
  static constexpr bool kHalves = false, kCuts = false;
  static constexpr int kResident = 2;

  static __device__ __forceinline__ uint32_t word(float x) {
    const float rounded = round_to_tf32(x);
    uint32_t bits;
    memcpy(&bits, &rounded, sizeof bits);
    return bits;
  }
  static __device__ __forceinline__ uint32_t pair(float, float) { return 0; }  // values are floats
  static __device__ __forceinline__ uint32_t relu(uint32_t word) { return word; }
  static __device__ __forceinline__ uint32_t right(const PackedMatrix& matrix, int k, int part, int member, int n) {
    return word(matrix.at(k + 4 * part + member, n));
  }
  template <bool kShared, bool kWords>
  static __device__ __forceinline__ LeftFragments left(const ProductValue& x, int row, int k, bool, int lane) {
    const int group = lane / 4, member = lane % 4;
    LeftFragments found;
#pragma unroll
    for (int i = 0; i < 8; ++i) {
      found.words[i / 4][i % 4] = word(x.at(row + group + 8 * (i % 2), k + 8 * (i / 4) + 4 * (i % 4 / 2) + member));
    }
    return found;
  }
  static __device__ __forceinline__ void multiply(float (&sums)[4], const LeftFragments& left, const uint4& right) {
    const uint32_t first[2] = {right.x, right.y}, second[2] = {right.z, right.w};
    multiply_tf32(sums, left.words[0], first);
    multiply_tf32(sums, left.words[1], second);
  }

  // A lane takes rows 2 m and 2 m + 1, not m and m + 4: its 32 lanes are then in different banks.
  static constexpr int kRows = 8;
  template <bool kShared, bool>
  static __device__ __forceinline__ void turned_left(uint32_t (&words)[4], const ProductValue& a, int i, int row,
                                                     int rows, int lane) {
#pragma unroll
    for (int j = 0; j < 4; ++j) words[j] = turned(a, row + j / 2, i + 8 * (j % 2), rows, lane);
  }
  template <bool kShared, bool>
  static __device__ __forceinline__ void turned_right(uint32_t (&words)[2][2], const ProductValue& b, int j, int row,
                                                      int rows, bool, int lane) {
#pragma unroll
    for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = turned(b, row + i % 2, j + 8 * (i / 2), rows, lane);
  }
  static __device__ __forceinline__ void multiply_turned(float (&sums)[4], const uint32_t (&left)[4],
                                                         const uint32_t (&right)[2]) {
    multiply_tf32(sums, left, right);
  }

 private:
  static __device__ __forceinline__ uint32_t turned(const ProductValue& a, int row, int column, int rows, int lane) {
    const int at = row + 2 * (lane % 4);
    return word(at < rows ? a.at(at, column + lane / 4) : 0.0f);
  }
};

// Steps -----------------------------------------------------------------------------------------------------------

// kShared: slots are in shared memory. kResident: blocks of a multiprocessor that registers are left for, 128 of a
// thread with two and 80 with three.
template <typename Numbers, int kDown, int kTall, bool kShared>
struct TensorSteps {
  static constexpr int kHeight = 16 * kDown * kTall;
  static constexpr int kResident = kShared && kTall == 1 ? Numbers::kResident : 2;
  static constexpr bool kInShared = kShared;
  using Tile = ProgramTile<kShared>;

  // What enters a product of float16 is cut off at its largest number, since infinities in a network soon become NaN,
  // except for gradients: whoever scales a loss looks for the infinite ones. What a turned matrix multiplies is taken
  // for one.
  static __device__ __forceinline__ void linear(const Tile& tile, const CudaStep& step) {
    const ProductValue x = product_value(tile, step.x, step.x_words);
    const int chunks = ceil_div(step.depth, Numbers::kChunk), across = 4 * padded(step.width, kProgramOutputs);
    const int warp = static_cast<int>(thread_again() / 32), lane = static_cast<int>(thread_again() % 32);
    const uint4* weights = reinterpret_cast<const uint4*>(tile.packed(step.weights)) + lane;
    const int row = 16 * kTall * (warp % kDown);
    const int wide = Numbers::kHalves && step.pairs >= 0 ? 2 * pair_words(step.width) : step.width;
#pragma unroll 1
    for (int first = 8 * kDown * (warp / kDown); first < wide; first += kProgramWide) {
      Sums sums = {};
      if (step.bias >= 0) {
        const float2* from = reinterpret_cast<const float2*>(tile.packed(step.bias) + first) + lane % 4;
#pragma unroll
        for (int t = 0; t < kDown; ++t) {
          const float2 two = load_constant(from + 4 * t);
#pragma unroll
          for (int r = 0; r < 2 * kTall; ++r) {
            sums[r / 2][t][r % 2 * 2] = two.x, sums[r / 2][t][r % 2 * 2 + 1] = two.y;
          }
        }
      } else if (step.added >= 0) {
        add(sums, step, tile, row, first, lane);
      }
      const uint4* from = weights + first / 8 * 32;
      if (Numbers::kHalves && x.has_words) {
        multiply<true>(sums, x, !step.turned, from, row, chunks, across, lane);
      } else {
        multiply<false>(sums, x, !step.turned, from, row, chunks, across, lane);
      }
      if (step.relu && step.slot >= 0) {
        for_each_sum([&](int r, int t, int i) { sums[r][t][i] = sums[r][t][i] < 0.0f ? 0.0f : sums[r][t][i]; });
      }
      if (step.sloped) cut_slopes(sums, product_value(tile, step.y, step.y_words), row, first, lane);
      if (tile.rows == kHeight && first + 8 * kDown <= step.width) {
        store<true>(sums, tile, step, row, first, lane);
      } else {
        store<false>(sums, tile, step, row, first, lane);
      }
    }
  }

  // partial[i][j] += sum over rows of a[row][i] b[row][j]. A warp has 16 by 32 of them at a time.
  static __device__ __forceinline__ void outer(const Tile& tile, const CudaStep& step) {
    const bool swapped = step.swapped;
    const ProductValue a = product_value(tile, step.x, step.x_words), b = product_value(tile, step.y, step.y_words);
    const int warp = static_cast<int>(thread_again() / 32), lane = static_cast<int>(thread_again() % 32);
    const bool words = Numbers::kHalves && a.has_words && b.has_words;
    float* const partial = tile.partial + step.partial;
    // By steps of 8 warps, without a division.
    const int down = 16 * ceil_div(a.columns, 16);
    int i0 = 16 * warp, j0 = 0;
#pragma unroll 1
    for (;; i0 += kProgramThreads / 2) {
      for (; i0 >= down; j0 += 32) i0 -= down;
      if (j0 >= b.columns) break;
      float sums[4][4] = {};
      float2 before[8];  // on their way meanwhile
      const bool pairs = j0 + 32 <= b.columns && i0 + 16 <= a.columns && !tile.fill;
      float* const corner = partial + (i0 + lane / 4) * step.stride + j0 + 2 * (lane % 4);
#pragma unroll
      for (int t = 0; t < 8; ++t) {
        before[t] = pairs ? *reinterpret_cast<const float2*>(corner + t % 2 * 8 * step.stride + t / 2 * 8)
                          : make_float2(0.0f, 0.0f);
      }
      if (words) {
        multiply_turned<true>(sums, a, b, i0, j0, tile.rows, swapped, lane);
      } else {
        multiply_turned<false>(sums, a, b, i0, j0, tile.rows, swapped, lane);
      }
      if (j0 + 32 <= b.columns && i0 + 16 <= a.columns) {
#pragma unroll
        for (int t = 0; t < 8; ++t) {
          const float x = sums[t / 2][t % 2 * 2] + before[t].x, y = sums[t / 2][t % 2 * 2 + 1] + before[t].y;
          *reinterpret_cast<float2*>(corner + t % 2 * 8 * step.stride + t / 2 * 8) = make_float2(x, y);
        }
        continue;
      }
#pragma unroll
      for (int i = 0; i < 16; ++i) {
        const MapPlace at = accumulator_place(static_cast<unsigned>(lane), i % 4);
        const int from = i0 + at.row, to = j0 + i / 4 * 8 + at.column;
        if (from >= a.columns || to >= b.columns) continue;
        float& entry = partial[from * step.stride + to];
        entry = (tile.fill ? 0.0f : entry) + sums[i / 4][i % 4];
      }
    }
  }

  // partial[j] += sum over rows of b[row][j], by a product with ones.
  static __device__ __forceinline__ void columns(const Tile& tile, const CudaStep& step) {
    const ProductValue b = product_value(tile, step.x, step.x_words);
    const int lane = static_cast<int>(thread_again() % 32);
    float* const partial = tile.partial + step.partial;
    if (!b.has_words) return sum_columns(tile, step);
    const uint32_t one = Numbers::pair(1.0f, 1.0f), ones[4] = {one, one, one, one};
    for (int j0 = 16 * static_cast<int>(thread_again() / 32); j0 < step.width; j0 += kProgramThreads / 2) {
      float sums[2][4] = {};
      for (int row = 0; row < tile.rows; row += Numbers::kRows) {
        uint32_t right[2][2];
        Numbers::template turned_right<kShared, true>(right, b, j0, row, tile.rows, false, lane);
        Numbers::multiply_turned(sums[0], ones, right[0]);
        Numbers::multiply_turned(sums[1], ones, right[1]);
      }
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        const int j = j0 + 8 * (i / 2) + 2 * lane + i % 2;
        if (lane < 4 && j < step.width) partial[j] = (tile.fill ? 0.0f : partial[j]) + sums[i / 2][i % 2];
      }
    }
  }

 private:
  using Sums = float[kTall][kDown][4];

  template <typename Visit>
  static __device__ __forceinline__ void for_each_sum(const Visit& visit) {
#pragma unroll
    for (int i = 0; i < 4 * kTall * kDown; ++i) visit(i / (4 * kDown), i / 4 % kDown, i % 4);
  }
  // Row and column of a sum, within the rows and columns of its warp.
  static __device__ __forceinline__ MapPlace place(int r, int t, int i, int lane) {
    const MapPlace own = accumulator_place(static_cast<unsigned>(lane), i);
    return {16 * r + own.row, 8 * t + own.column};
  }

  template <bool kWords>
  static __device__ __forceinline__ void multiply(Sums& sums, const ProductValue& x, bool cut, const uint4* from,
                                                  int row, int chunks, int across, int lane) {
#pragma unroll kWords ? 2 : 1
    for (int c = 0; c < chunks; ++c, from += across) {
      uint4 right[kDown];
#pragma unroll
      for (int t = 0; t < kDown; ++t) right[t] = load_constant(from + 32 * t);
#pragma unroll
      for (int r = 0; r < kTall; ++r) {
        const auto left = Numbers::template left<kShared, kWords>(x, row + 16 * r, Numbers::kChunk * c, cut, lane);
#pragma unroll
        for (int t = 0; t < kDown; ++t) Numbers::multiply(sums[r][t], left, right[t]);
      }
    }
  }

  // sums += over rows a's 16 columns from i0 on by b's 32 from j0 on. kWords: both lie in words, which are 0 up to
  // there and in rows without a sample.
  template <bool kWords>
  static __device__ __forceinline__ void multiply_turned(float (&sums)[4][4], const ProductValue& a,
                                                         const ProductValue& b, int i0, int j0, int rows, bool swapped,
                                                         int lane) {
    const int tiles = ceil_div(b.columns - j0, 8);
#pragma unroll kWords ? 4 : 1
    for (int row = 0; row < rows; row += Numbers::kRows) {
      uint32_t left[4];
      Numbers::template turned_left<kShared, kWords>(left, a, i0, row, rows, lane);
      if constexpr (Numbers::kCuts) {
        for (uint32_t& word : left) word = swapped ? clamp_halves(word) : word;
      }
#pragma unroll
      for (int pair = 0; pair < 2; ++pair) {
        if (!kWords && 2 * pair >= tiles) continue;
        uint32_t right[2][2];
        Numbers::template turned_right<kShared, kWords>(right, b, j0 + 16 * pair, row, rows, !swapped, lane);
        Numbers::multiply_turned(sums[2 * pair], left, right[0]);
        Numbers::multiply_turned(sums[2 * pair + 1], left, right[1]);
      }
    }
  }

  // What is added to the product, where that is a value.
  static __device__ __forceinline__ void add(Sums& sums, const CudaStep& step, const Tile& tile, int row, int first,
                                             int lane) {
    const Rows added = tile.operand(tile.call.code.operands[step.added]);
    for_each_sum([&](int r, int t, int i) {
      const MapPlace at = place(r, t, i, lane);
      const bool there = row + at.row < tile.rows && first + at.column < step.width;
      if (there) sums[r][t][i] = added.at(row + at.row, first + at.column);
    });
  }

  // 0 where a value of ReLU is.
  static __device__ __forceinline__ void cut_slopes(Sums& sums, const ProductValue& slope, int row, int first,
                                                    int lane) {
    if (Numbers::kHalves && slope.has_words) {
      const uint32_t* corner = slope.words + (row + lane / 4) * slope.stride + first / 2 + lane % 4;
      for_each_sum([&](int r, int t, int i) {
        const uint32_t word = corner[(16 * r + i / 2 * 8) * slope.stride + 4 * t];
        sums[r][t][i] = positive_half(i % 2 == 0 ? word : word >> 16) ? sums[r][t][i] : 0.0f;
      });
      return;
    }
    for_each_sum([&](int r, int t, int i) {
      const MapPlace at = place(r, t, i, lane);
      const bool cut = slope.at(row + at.row, first + at.column) <= 0.0f;  // NaN is not
      sums[r][t][i] = cut ? 0.0f : sums[r][t][i];
    });
  }

  // kWhole: there is a sample in every row, and each sum has a column.
  template <bool kWhole>
  static __device__ __forceinline__ void store(const Sums& sums, const Tile& tile, const CudaStep& step, int row,
                                               int first, int lane) {
    const int width = step.width;
    if (Numbers::kHalves && step.pairs >= 0) {
      // Words are 0 where there is no sample and no column, since products take whole sixteens of both.
      const int wide = 2 * pair_words(width), stride = pair_stride(width);
      uint32_t* const corner =
          reinterpret_cast<uint32_t*>(tile.slot(step.pairs)) + (row + lane / 4) * stride + first / 2 + lane % 4;
      for_each_sum([&](int r, int t, int i) {
        if (i % 2 == 1) return;
        const MapPlace at = place(r, t, i, lane);
        const int column = first + at.column;
        float x = sums[r][t][i], y = sums[r][t][i + 1];
        if (!kWhole && column >= wide) return;
        if (!kWhole && (row + at.row >= tile.rows || column >= width)) x = 0.0f;
        if (!kWhole && (row + at.row >= tile.rows || column + 1 >= width)) y = 0.0f;
        const uint32_t word = Numbers::pair(x, y);
        corner[(16 * r + 4 * i) * stride + 4 * t] = step.relu ? Numbers::relu(word) : word;
      });
    }
    if (step.slot < 0) return;
    float* const floats = tile.slot(step.slot);
    const int stride = step.stride;
    for_each_sum([&](int r, int t, int i) {
      if (i % 2 == 1) return;
      const MapPlace at = place(r, t, i, lane);
      const int column = first + at.column;
      float* const to = floats + (row + at.row) * stride + column;
      if (!kWhole && (row + at.row >= tile.rows || column >= width)) return;
      if (kWhole || column + 1 < width) {
        *reinterpret_cast<float2*>(to) = make_float2(sums[r][t][i], sums[r][t][i + 1]);
      } else {
        *to = sums[r][t][i];
      }
    });
  }
};

// In float32.
template <int kDown, bool kShared>
struct FloatSteps {
  static constexpr int kHeight = 16 * kDown;
  static constexpr int kResident = kShared ? 3 : 2;
  static constexpr bool kInShared = kShared;
  using Tile = ProgramTile<kShared>;

  static __device__ __forceinline__ void linear(const Tile& tile, const CudaStep& step) {
    const int thread = static_cast<int>(thread_again());
    if (step.width > 16) {
#pragma unroll 1
      for (int first = 4 * (thread % 16); first < step.width; first += kProgramWide) {
        block<kDown>(tile, step, thread / 16, first);
      }
      return;
    }
    // Few outputs: a row a thread.
    const int shift = step.width > 4 ? 2 : 0, row = thread >> shift, first = 4 * (thread & ((1 << shift) - 1));
    if (row < kHeight && first < step.width) block<1>(tile, step, row, first);
  }

  // As of TensorSteps; a thread has 4 by 4 at a time.
  static __device__ __forceinline__ void outer(const Tile& tile, const CudaStep& step) {
    const ProductValue a = product_value(tile, step.x, false), b = product_value(tile, step.y, false);
    const bool whole = (step.x.start | step.x.stride | step.y.start | step.y.stride) % 4 == 0;
    const int across = ceil_div(b.columns, 4), units = ceil_div(a.columns, 4) * across;
#pragma unroll 1
    for (int unit = static_cast<int>(thread_again()); unit < units; unit += kProgramThreads) {
      const int i0 = 4 * (unit / across), j0 = 4 * (unit % across);
      float4 sums[4] = {};
      if (whole) {
#pragma unroll 4
        for (int row = 0; row < tile.rows; ++row) {
          const float4 x = *reinterpret_cast<const float4*>(a.floats + row * a.stride + i0);
          const float4 y = *reinterpret_cast<const float4*>(b.floats + row * b.stride + j0);
          accumulate(sums[0], x.x, y);
          accumulate(sums[1], x.y, y);
          accumulate(sums[2], x.z, y);
          accumulate(sums[3], x.w, y);
        }
      } else {
#pragma unroll 1
        for (int row = 0; row < tile.rows; ++row) {
          const float4 y = make_float4(b.at(row, j0), b.at(row, j0 + 1), b.at(row, j0 + 2), b.at(row, j0 + 3));
#pragma unroll
          for (int i = 0; i < 4; ++i) accumulate(sums[i], a.at(row, i0 + i), y);
        }
      }
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        if (i0 + i >= a.columns) continue;
        float* const at = tile.partial + step.partial + (i0 + i) * step.stride + j0;
        if (j0 + 4 <= b.columns) {
          float4 entry = tile.fill ? make_float4(0.0f, 0.0f, 0.0f, 0.0f) : *reinterpret_cast<float4*>(at);
          entry.x += sums[i].x, entry.y += sums[i].y, entry.z += sums[i].z, entry.w += sums[i].w;
          *reinterpret_cast<float4*>(at) = entry;
          continue;
        }
        const float three[3] = {sums[i].x, sums[i].y, sums[i].z};
#pragma unroll
        for (int j = 0; j < 3; ++j) {
          if (j0 + j < b.columns) at[j] = (tile.fill ? 0.0f : at[j]) + three[j];
        }
      }
    }
  }

  static __device__ __forceinline__ void columns(const Tile& tile, const CudaStep& step) { sum_columns(tile, step); }

 private:
  // Rows row, row + 16 and so on, by four columns.
  template <int kRows>
  static __device__ __forceinline__ void block(const Tile& tile, const CudaStep& step, int row, int first) {
    const ProductValue value = product_value(tile, step.x, false);
    const int stride = padded(step.width, kProgramOutputs), down = 16 * value.stride, depth = step.depth;
    const float* const x = value.floats + row * value.stride;
    float4 sums[kRows] = {};
    if (step.bias >= 0) {
      const float4 four = load_constant(reinterpret_cast<const float4*>(tile.packed(step.bias) + first));
#pragma unroll
      for (int r = 0; r < kRows; ++r) sums[r] = four;
    } else if (step.added >= 0) {
      const Rows rows = tile.operand(tile.call.code.operands[step.added]);
#pragma unroll
      for (int r = 0; r < kRows; ++r) {
        const int at = row + 16 * r;
        const auto added = [&](int i) {
          return at < tile.rows && first + i < step.width ? rows.at(at, first + i) : 0.0f;
        };
        sums[r] = make_float4(added(0), added(1), added(2), added(3));
      }
    }
    const float* w = tile.packed(step.weights) + first;
    int k = 0;
    if ((step.x.start | step.x.stride) % 4 == 0) {
#pragma unroll 2
      for (; k + 4 <= depth; k += 4, w += 4 * stride) {
        float4 y[4];
#pragma unroll
        for (int i = 0; i < 4; ++i) y[i] = load_constant(reinterpret_cast<const float4*>(w + i * stride));
#pragma unroll
        for (int r = 0; r < kRows; ++r) {
          const float4 four = *reinterpret_cast<const float4*>(x + r * down + k);
          accumulate(sums[r], four.x, y[0]);
          accumulate(sums[r], four.y, y[1]);
          accumulate(sums[r], four.z, y[2]);
          accumulate(sums[r], four.w, y[3]);
        }
      }
    }
#pragma unroll 1
    for (; k < depth; ++k, w += stride) {
      const float4 y = load_constant(reinterpret_cast<const float4*>(w));
#pragma unroll
      for (int r = 0; r < kRows; ++r) accumulate(sums[r], x[r * down + k], y);
    }
    const ProductValue slope = product_value(tile, step.y, false);
    float* const to = tile.slot(step.slot) + first;
#pragma unroll
    for (int r = 0; r < kRows; ++r) {
      const int at = row + 16 * r;
      if (at >= tile.rows) continue;
      float four[4] = {sums[r].x, sums[r].y, sums[r].z, sums[r].w};
#pragma unroll
      for (int i = 0; i < 4; ++i) {  // comparisons keep NaN
        if (step.relu) four[i] = four[i] < 0.0f ? 0.0f : four[i];
        if (step.sloped) four[i] = slope.at(at, first + i) <= 0.0f ? 0.0f : four[i];
      }
      if (first + 4 <= step.width) {
        *reinterpret_cast<float4*>(to + at * step.stride) = make_float4(four[0], four[1], four[2], four[3]);
        continue;
      }
#pragma unroll
      for (int i = 0; i < 3; ++i) {
        if (first + i < step.width) to[at * step.stride + i] = four[i];
      }
    }
  }
  static __device__ __forceinline__ void accumulate(float4& sums, float x, const float4& y) {
    sums.x = fmaf(x, y.x, sums.x);
    sums.y = fmaf(x, y.y, sums.y);
    sums.z = fmaf(x, y.z, sums.z);
    sums.w = fmaf(x, y.w, sums.w);
  }
};

}  // namespace voronerf
