// Grouped products of any width on CUDA (grouped_mlp_cuda_layers.h): tiles of shared memory filled by asynchronous
// copies, and the two kernels that are made of them.
#pragma once

#include "common/index_maps.h"
#include "network/cuda/grouped_mlp_cuda_layers.h"
#include "network/cuda/grouped_mlp_cuda_tile.h"

namespace voronerf {

// Rows of a slab, and where the device finds those of a cell.
struct MlpSlab {
  const int32_t* offsets;
  const int32_t* first_task;  // [k+1]
  int64_t n, k, first, rows;  // the slab is rows first .. first + rows of the batch
};

// Rows of a cell in a slab, from the slab's beginning, kept inside whatever the offsets say.
struct MlpRows {
  int64_t begin, end;
};
__device__ inline MlpRows mlp_slab_rows(const MlpSlab& slab, int64_t cell) {
  const auto inside = [&](int64_t row) { return row < 0 ? 0 : row > slab.rows ? slab.rows : row; };
  const int64_t begin = inside(slab.offsets[cell] - slab.first), end = inside(slab.offsets[cell + 1] - slab.first);
  return {begin, end < begin ? begin : end};
}

// The cell of tile number `tile` of the slab; -1 where there are fewer.
__device__ inline int64_t mlp_slab_cell(const MlpSlab& slab, int64_t tile) {
  return tile >= slab.first_task[slab.k] ? -1 : last_not_above(slab.first_task, slab.k, tile);
}

// One of the products that are summed: a [rows of the slab][depth], and a cell's b, [columns][depth], or transposed
// [depth][columns].
struct MlpPart {
  const void *a, *b;
  int64_t a_stride, b_stride, b_cell, depth;
};
struct MlpParts {
  MlpPart parts[kLayersParts];
  int count;
  int64_t columns;  // a multiple of 16
};

constexpr int kLayersThreads = 128;
constexpr int kLayersSkew = 8;  // elements more in the rows of a transposed tile

// Where tiles lie in shared memory; columns of the depth are chunks of 64 bytes.
template <typename Element>
struct MlpChunk {
  static constexpr int kDepth = kLayersChunkBytes / static_cast<int>(sizeof(Element));
  static constexpr int kStride = kDepth + 16 / static_cast<int>(sizeof(Element));  // of a tile by rows
  static constexpr int kTall = kLayersRows + kLayersSkew;                          // of a tile by depth, of 64 rows
  static constexpr int kWide = kLayersColumns + kLayersSkew;                       // of a tile by depth, of 128 columns
  static constexpr int kLeft = kLayersRows * kStride > kDepth* kTall ? kLayersRows * kStride : kDepth * kTall;
  static constexpr int kRight = kLayersColumns * kStride > kDepth* kWide ? kLayersColumns * kStride : kDepth * kWide;
  static constexpr int kStage = kLeft + kRight;
  static constexpr int kBytes = kLayersStages * kStage * static_cast<int>(sizeof(Element));
  static_assert(kBytes <= 48 * 1024, "every device has it without being asked");
  static_assert(kLayersRows * kWide * 4 <= kBytes, "sums fit where the chunks were");
};

// Fills a tile [kRows][bytes of a row] by all threads. Rows from `rows` on are cleared, and so are bytes of a row from
// `bytes` on, a multiple of 16; kBytes are there for a row.
template <int kRows, int kBytes>
__device__ __forceinline__ void mlp_fetch(void* to, int to_stride, const void* from, int64_t from_stride, int64_t rows,
                                          int64_t bytes) {
  constexpr int kWords = kBytes / 16;
  static_assert(kRows * kWords % kLayersThreads == 0, "no thread is left over");
  const int height = rows < kRows ? static_cast<int>(rows) : kRows;
  const int width = bytes < kBytes ? static_cast<int>(bytes) : kBytes;
#pragma unroll
  for (int i = 0; i < kRows * kWords / kLayersThreads; ++i) {
    const auto [row, word] = fetched_word(threadIdx.x, i, kLayersThreads, kWords);
    const bool there = row < height && 16 * word < width;
    const auto* source = static_cast<const unsigned char*>(from) + (there ? row * from_stride + 16 * word : 0);
    copy_async(static_cast<unsigned char*>(to) + row * to_stride + 16 * word, source, there);
  }
}

// visit(row, column, x, y) for every pair of a warp's sums, row and column within the block.
template <typename Visit>
__device__ __forceinline__ void mlp_visit(const MlpSums<2, kMlpTiles>& sums, int tiles, const Visit& visit) {
#pragma unroll
  for (int r = 0; r < 2; ++r) {
#pragma unroll
    for (int t = 0; t < kMlpTiles; ++t) {
      if (t >= tiles) continue;
#pragma unroll
      for (int i = 0; i < 4; i += 2) {
        const MapPlace place = product_place(threadIdx.x, r, t, i);
        visit(place.row, place.column, sums[r][t][i], sums[r][t][i + 1]);
      }
    }
  }
}

__device__ inline void mlp_clear_sums(MlpSums<2, kMlpTiles>& sums) {
#pragma unroll
  for (int r = 0; r < 2; ++r) {
#pragma unroll
    for (int t = 0; t < kMlpTiles; ++t) {
#pragma unroll
      for (int i = 0; i < 4; ++i) sums[r][t][i] = 0.0f;
    }
  }
}

// Sums of products for the rows of a cell. Grid (tiles of a slab, tiles of columns). finish(cell, row of the slab,
// column, x, y) takes pairs of columns.
template <typename Products, bool kTransposed, typename Finish>
__global__ void __launch_bounds__(kLayersThreads, 3)
    mlp_product_kernel(const MlpSlab slab, const MlpParts parts, const Finish finish) {
  using Element = typename Products::Element;
  using Chunk = MlpChunk<Element>;
  const int64_t cell = mlp_slab_cell(slab, blockIdx.x);
  if (cell < 0) return;  // the whole block
  VN_DYN_SHARED(Element, shared);
  const MlpRows of_cell = mlp_slab_rows(slab, cell);
  const int64_t row = of_cell.begin + (blockIdx.x - slab.first_task[cell]) * kLayersRows, rows = of_cell.end - row;
  const int64_t column = static_cast<int64_t>(blockIdx.y) * kLayersColumns, columns = parts.columns - column;
  const int tiles = product_warp_tiles(threadIdx.x, columns);
  constexpr int kSize = static_cast<int>(sizeof(Element));

  // The chunks of all parts one after another; one cursor fetches, another one multiplies.
  int part = 0, stage = 0;
  int64_t depth = 0;
  const auto fetch = [&] {
    if (part < parts.count) {
      const MlpPart& from = parts.parts[part];
      Element* left = shared + stage * Chunk::kStage;
      Element* right = left + Chunk::kLeft;
      const int64_t there = from.depth - depth;
      mlp_fetch<kLayersRows, kLayersChunkBytes>(left, Chunk::kStride * kSize,
                                                static_cast<const Element*>(from.a) + row * from.a_stride + depth,
                                                from.a_stride * kSize, rows, there * kSize);
      const Element* b = static_cast<const Element*>(from.b) + cell * from.b_cell;
      if constexpr (kTransposed) {
        mlp_fetch<Chunk::kDepth, kLayersColumns * kSize>(right, Chunk::kWide * kSize,
                                                         b + depth * from.b_stride + column, from.b_stride * kSize,
                                                         there, columns * kSize);
      } else {
        mlp_fetch<kLayersColumns, kLayersChunkBytes>(right, Chunk::kStride * kSize, b + column * from.b_stride + depth,
                                                     from.b_stride * kSize, columns, there * kSize);
      }
      depth += Chunk::kDepth;
      if (depth >= from.depth) ++part, depth = 0;
    }
    stage = stage == kLayersStages - 1 ? 0 : stage + 1;
    copy_commit();  // empty at the end, so that groups are counted alike
  };
  for (int i = 0; i < kLayersStages - 1; ++i) fetch();
  MlpSums<2, kMlpTiles> sums;
  mlp_clear_sums(sums);
  int multiplied = 0;
  for (int p = 0; p < parts.count; ++p) {
    for (int64_t at = 0; at < parts.parts[p].depth; at += Chunk::kDepth) {
      copy_wait<kLayersStages - 2>();
      __syncthreads();  // the chunk is there for all, and all are done with the one before
      fetch();
      const Element* left = shared + multiplied * Chunk::kStage;
      const Element* right = left + Chunk::kLeft;
      const int64_t there = parts.parts[p].depth - at;
      const int take = there < Chunk::kDepth ? static_cast<int>(there) : Chunk::kDepth;
      const Element* a = left + product_warp_place(threadIdx.x).row * Chunk::kStride;
      if constexpr (kTransposed) {
        Products::template multiply<false, true>(
            sums, a, Chunk::kStride, right + product_warp_place(threadIdx.x).column, Chunk::kWide, take, tiles);
      } else {
        Products::template multiply<false, false>(sums, a, Chunk::kStride,
                                                  right + product_warp_place(threadIdx.x).column * Chunk::kStride,
                                                  Chunk::kStride, take, tiles);
      }
      multiplied = multiplied == kLayersStages - 1 ? 0 : multiplied + 1;
    }
  }
  // Through shared memory, so that rows are written whole, and what finish() does is compiled once and not for every
  // register.
  copy_wait<0>();
  __syncthreads();  // the last chunk is read by all
  float* results = reinterpret_cast<float*>(shared);
  mlp_visit(sums, tiles, [&](int i, int j, float x, float y) {
    *reinterpret_cast<float2*>(results + i * Chunk::kWide + j) = make_float2(x, y);
  });
  __syncthreads();
  const int pairs = static_cast<int>(columns < kLayersColumns ? columns : kLayersColumns) / 2;
  const int count = static_cast<int>(rows < kLayersRows ? rows : kLayersRows) * pairs;
#pragma unroll 1
  for (int number = threadIdx.x; number < count; number += kLayersThreads) {
    const int i = number / pairs, j = 2 * (number - i * pairs);
    const float2 pair = *reinterpret_cast<const float2*>(results + i * Chunk::kWide + j);
    finish(cell, row + i, column + j, pair.x, pair.y);
  }
}

// Gradient of a layer's weights to one source, and with the first source of its biases.
struct MlpWeightGradient {
  const void *gradients, *values;  // [rows of the slab][stride]
  int64_t gradient_stride, value_stride;
  int64_t outputs, inputs;  // multiples of 16
  int64_t k;
  float* weights;  // partials: [splits][k][outputs][stride], `stride` between rows, `cell` between cells
  float* biases;   // null with the other sources
  int64_t stride, cell;
  int splits;
  bool first;  // of the slabs: nothing is there yet
};

// Grid (cells x tiles of inputs and outputs, splits).
template <typename Products>
__global__ void __launch_bounds__(kLayersThreads, 3)
    mlp_weight_gradient_kernel(const MlpSlab slab, const MlpWeightGradient to) {
  using Element = typename Products::Element;
  using Chunk = MlpChunk<Element>;
  VN_DYN_SHARED(Element, shared);
  constexpr int kSize = static_cast<int>(sizeof(Element));
  const GradientTile tile = gradient_tile(blockIdx.x, to.outputs, to.inputs, kLayersRows, kLayersColumns);
  const int64_t cell = tile.cell, output = tile.output, input = tile.input;
  const MlpRows of_cell = mlp_slab_rows(slab, cell);
  // Whole chunks for every part but the last.
  const RowRange part = part_of_rows(of_cell.begin, of_cell.end, blockIdx.y, to.splits, Chunk::kDepth);
  const int64_t begin = part.begin, end = part.end;
  // Most cells have no rows in a slab; there is nothing to add then, and to begin with zero.
  if (begin >= end && !to.first) return;  // the whole block
  const int64_t outputs = to.outputs - output, inputs = to.inputs - input;
  const int tiles = product_warp_place(threadIdx.x).row < outputs ? product_warp_tiles(threadIdx.x, inputs) : 0;

  int64_t fetched = begin;
  int stage = 0;
  const auto fetch = [&] {
    if (fetched < end) {
      Element* left = shared + stage * Chunk::kStage;
      Element* right = left + Chunk::kLeft;
      mlp_fetch<Chunk::kDepth, kLayersRows * kSize>(
          left, Chunk::kTall * kSize, static_cast<const Element*>(to.gradients) + fetched * to.gradient_stride + output,
          to.gradient_stride * kSize, end - fetched, outputs * kSize);
      mlp_fetch<Chunk::kDepth, kLayersColumns * kSize>(
          right, Chunk::kWide * kSize, static_cast<const Element*>(to.values) + fetched * to.value_stride + input,
          to.value_stride * kSize, end - fetched, inputs * kSize);
    }
    fetched += Chunk::kDepth;
    stage = stage == kLayersStages - 1 ? 0 : stage + 1;
    copy_commit();
  };
  for (int i = 0; i < kLayersStages - 1; ++i) fetch();
  MlpSums<2, kMlpTiles> sums;
  mlp_clear_sums(sums);
  const int column = threadIdx.x;
  const bool biased = to.biases != nullptr && input == 0 && column < kLayersRows && column < outputs;
  float bias = 0.0f;
  int multiplied = 0;
  for (int64_t at = begin; at < end; at += Chunk::kDepth) {
    copy_wait<kLayersStages - 2>();
    __syncthreads();
    fetch();
    const Element* left = shared + multiplied * Chunk::kStage;
    const Element* right = left + Chunk::kLeft;
    Products::template multiply<true, true>(sums, left + product_warp_place(threadIdx.x).row, Chunk::kTall,
                                            right + product_warp_place(threadIdx.x).column, Chunk::kWide, Chunk::kDepth,
                                            tiles);
    if (biased) {
      for (int row = 0; row < Chunk::kDepth; ++row) bias += Products::load(left + row * Chunk::kTall + column);
    }
    multiplied = multiplied == kLayersStages - 1 ? 0 : multiplied + 1;
  }
  const int64_t place = (blockIdx.y * to.k + cell) * to.cell;
  mlp_visit(sums, tiles, [&](int i, int j, float x, float y) {
    if (i >= outputs) return;
    float2* pair = reinterpret_cast<float2*>(to.weights + place + (output + i) * to.stride + input + j);
    *pair = to.first ? make_float2(x, y) : make_float2(pair->x + x, pair->y + y);
  });
  if (biased) {
    float* sum = to.biases + place + output + column;
    *sum = to.first ? bias : *sum + bias;
  }
}

}  // namespace voronerf
