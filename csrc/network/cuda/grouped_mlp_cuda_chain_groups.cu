// The chained network with products of four warps, on devices of compute capability 9.0 (cuda_wgmma.h).
#include "network/cuda/grouped_mlp_cuda_chain_kernel.h"

namespace voronerf {

bool mlp_chain_groups_compiled() {
  cudaFuncAttributes attributes{};
  VN_CUDA_CHECK(cudaFuncGetAttributes(&attributes, mlp_chain_kernel<ChainGroups<true>, 64>));
  return attributes.maxThreadsPerBlock >= chain_threads(64);
}

void mlp_chain_groups_cuda(const MlpChainPlan& plan, const MlpCudaData& data, void* stream) {
  mlp_chain_launch<ChainGroups>(plan, data, stream);
}

}  // namespace voronerf
