// The forward pass of grouped_mlp on CUDA: a block a task, tiles of rows through all layers (grouped_mlp_cuda_plan.h).
#include "network/cuda/grouped_mlp_cuda_hash.h"

namespace voronerf {

namespace {

template <typename Products, int kRowTiles>
__global__ void __launch_bounds__(128, 3)
    mlp_forward_kernel(const MlpCudaPlan plan, const MlpCudaData data, const HashEncoding grid) {
  using Element = typename Products::Element;
  MlpTask task;
  if (!mlp_find_task(data, plan.task_rows, blockIdx.x, task)) return;  // the whole block
  VN_DYN_SHARED(Element, shared);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  constexpr int kRows = 16 * kRowTiles;
  Element* region = shared + warp * plan.region;
  Element* slot = shared + plan.warps * plan.region;
  const unsigned char* packed = data.packed + task.cell * plan.packed_bytes;
  if (plan.resident) {
    mlp_copy(reinterpret_cast<unsigned char*>(slot), 0, packed, 0, 1,
             static_cast<int>(sizeof(Element)) * plan.packed_weights);
    __syncthreads();
  }
  for (int64_t tile = task.begin; tile < task.end; tile += plan.warps * kRows) {
    const int64_t first = tile + warp * kRows;
    if (plan.positions.hashed) {
      mlp_hash_encode<Products, kRows>(plan, data, grid, task.cell, region, first, task.end);
    } else {
      mlp_encode<Products, kRows>(plan.positions, region, first, task.end,
                                  [&](int64_t row) { return mlp_positions(plan, data, row); });
    }
    mlp_encode<Products, kRows>(plan.directions, region, first, task.end,
                                [&](int64_t row) { return mlp_directions(plan, data, row); });
    __syncwarp();
    mlp_run<Products, kRowTiles>(
        plan, region, slot, packed, [&](int l, int chunk, const MlpSums<kRowTiles, kMlpTiles>& sums) {
          for (int o = 0; o < plan.output_count; ++o) {
            if (plan.outputs[o] != l) continue;
#pragma unroll
            for (int r = 0; r < kRowTiles; ++r) {
#pragma unroll
              for (int t = 0; t < kMlpTiles; ++t) {
#pragma unroll
                for (int i = 0; i < 4; ++i) {
                  const int64_t row = first + 16 * r + lane / 4 + 8 * (i / 2);
                  const int column = chunk + 8 * t + 2 * (lane % 4) + i % 2;
                  if (row < task.end && column < plan.layers[l].width) {
                    data.out[mlp_source_row(data, row) * plan.out_features + plan.output_columns[o] + column] =
                        sums[r][t][i];
                  }
                }
              }
            }
          }
        });
  }
}

template <typename Products>
void launch(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid, void* stream) {
  const unsigned blocks = static_cast<unsigned>(plan.tasks), threads = 32 * plan.warps;
  mlp_allow_shared(mlp_forward_kernel<Products, 2>);
  VN_LAUNCH((mlp_forward_kernel<Products, 2>), blocks, threads, plan.shared_bytes, stream, plan, data, grid);
}

}  // namespace

void mlp_tiles_cuda(const MlpCudaPlan& plan, MlpCudaData data, const HashEncoding& grid,
                    const MlpCudaParameters& parameters, unsigned char* workspace, void* stream) {
  if (data.n == 0) return;
  const MlpCudaWorkspace parts = mlp_cuda_workspace(plan, data.k, false);
  data.packed = workspace + parts.packed;
  data.first_task = reinterpret_cast<int32_t*>(workspace + parts.first_task);
  mlp_cuda_prepare(plan, data, parameters, {{data.out}, {plan.out_features}}, stream);
  mlp_with_products(plan.precision, [&](auto products) { launch<decltype(products)>(plan, data, grid, stream); });
}

}  // namespace voronerf
