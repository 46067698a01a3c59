// The kernel of the backward pass by what it multiplies: each has a file of its own, since each takes half a minute to
// compile for one architecture.
#pragma once

#include "network/cuda/grouped_mlp_cuda.h"
#include "network/cuda/grouped_mlp_cuda_operands.h"

namespace voronerf {

template <typename Products>
void mlp_backward_launch(const MlpCudaPlan& plan, const MlpCudaData& data, const HashEncoding& grid, void* stream);

}  // namespace voronerf
