// The backward pass of grouped_mlp on CUDA: what precedes and follows its kernel, and which one that is.
#include "network/cuda/grouped_mlp_cuda_backward.h"

namespace voronerf {

void mlp_tiles_backward_cuda(const MlpCudaPlan& plan, MlpCudaData data, const HashEncoding& grid,
                             const MlpCudaParameters& parameters, const MlpCudaParameterGradients* gradients,
                             unsigned char* workspace, void* stream) {
  const MlpCudaWorkspace parts = mlp_cuda_workspace(plan, data.k, gradients != nullptr);
  data.packed = workspace + parts.packed;
  data.first_task = reinterpret_cast<int32_t*>(workspace + parts.first_task);
  data.partials = gradients == nullptr ? nullptr : reinterpret_cast<float*>(workspace + parts.partials);
  MlpStrays strays{};
  const struct {
    const MlpCudaInput& input;
    float* gradient;
  } wanted[] = {{plan.positions, data.grad_positions}, {plan.directions, data.grad_directions}};
  for (int i = 0; i < 2; ++i) {
    if (!wanted[i].input.used) {
      mlp_cuda_clear_gradient(data, false, wanted[i].input.raw, wanted[i].gradient, stream);
    } else {
      strays.rows[i] = wanted[i].gradient;
      strays.widths[i] = wanted[i].input.raw;
    }
  }
  mlp_cuda_prepare(plan, data, parameters, strays, stream);
  if (data.n > 0) {
    mlp_with_products(plan.precision,
                      [&](auto products) { mlp_backward_launch<decltype(products)>(plan, data, grid, stream); });
  }
  if (gradients != nullptr) mlp_cuda_reduce(plan, data, *gradients, stream);
}

}  // namespace voronerf
