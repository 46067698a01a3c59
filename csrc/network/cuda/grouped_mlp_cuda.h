// Launchers of grouped_mlp on CUDA; contracts as in grouped_mlp.h. Offsets that fall or exceed n cannot be refused
// without a host read: rows outside are not touched.
#pragma once

#include "network/cuda/grouped_mlp_cuda_plan.h"

namespace voronerf {

// Pointers of one call, all on the device; the kernels take it by value.
struct MlpCudaData {
  const float *positions, *directions;
  const int32_t *direction_index, *order, *offsets;
  int64_t n, k, r;         // r: rows of directions
  unsigned char* packed;   // in the workspace
  int32_t* first_task;     // in the workspace, [k+1]
  float* partials;         // in the workspace, null without gradients of parameters
  float* out;              // forward
  const float* grad_out;   // backward
  float* grad_positions;   // null: not wanted
  float* grad_directions;  // one row a sample, null: not wanted
  // Hashed positions [n, padded], in their sorted order: filled forward, null: not kept; read backward.
  float* encoded;
  float* grad_features;  // of a hash grid's tables, null: not wanted
};

struct MlpCudaParameters {
  const float *weights[kMlpCudaLayers], *biases[kMlpCudaLayers];
};

struct MlpCudaParameterGradients {
  float *weights[kMlpCudaLayers], *biases[kMlpCudaLayers];
};

// Threads of a block of a kernel with blocks for each cell and layer, and how many blocks each of those should have:
// few cells need several.
constexpr int kMlpLayerThreads = 256;
unsigned mlp_cuda_layer_blocks(int64_t k, int layers, int64_t elements);

// Properties of the current device, which each thread asks for once.
const MlpCudaDevice& mlp_cuda_device();

// Rows to clear where they are of no cell; null where there are none.
struct MlpStrays {
  float* rows[2];
  int widths[2];
};

// grid: of positions that are hashed.
void mlp_tiles_cuda(const MlpCudaPlan& plan, MlpCudaData data, const HashEncoding& grid,
                    const MlpCudaParameters& parameters, unsigned char* workspace, void* stream);

// gradients: null without those of parameters.
void mlp_tiles_backward_cuda(const MlpCudaPlan& plan, MlpCudaData data, const HashEncoding& grid,
                             const MlpCudaParameters& parameters, const MlpCudaParameterGradients* gradients,
                             unsigned char* workspace, void* stream);

// Steps around the kernel of rows: in one launch weights packed, tasks mapped and rows of no cell cleared before it;
// partials summed.
void mlp_cuda_number_tasks(const MlpCudaData& data, int64_t task_rows, int64_t tasks, void* stream);
void mlp_cuda_prepare(const MlpCudaPlan& plan, const MlpCudaData& data, const MlpCudaParameters& parameters,
                      const MlpStrays& strays, void* stream);
void mlp_cuda_zero_strays(const MlpCudaData& data, int width, float* rows, void* stream);
void mlp_cuda_clear_gradient(const MlpCudaData& data, bool used, int width, float* gradient, void* stream);
void mlp_cuda_reduce(const MlpCudaPlan& plan, const MlpCudaData& data, const MlpCudaParameterGradients& gradients,
                     void* stream);

}  // namespace voronerf
