#include "bindings/grouped_mlp.h"

#include "network/cuda/grouped_mlp_cuda_layers.h"

namespace voronerf {

VN_OPAQUE(MlpCudaCall);

VN_BINDINGS(module) {
  module.cpu("grouped_mlp", VN_CPU(grouped_mlp_cpu));
  module.cpu("grouped_mlp_backward", VN_CPU(grouped_mlp_backward_cpu));
  module.cuda("grouped_mlp", VN_CUDA(grouped_mlp_cuda));
  module.cuda("grouped_mlp_backward", VN_CUDA(grouped_mlp_backward_cuda));
  module.cuda("grouped_mlp_hashes", VN_CUDA(grouped_mlp_hashes_cuda));
  module.cuda("grouped_mlp_call", VN_CUDA(grouped_mlp_call_cuda));
  module.plain("grouped_mlp_workspace", VN_CUDA(grouped_mlp_workspace_cuda));
}

}  // namespace voronerf
