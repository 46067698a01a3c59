#include "network/cuda/grouped_mlp_cuda_backward_kernel.h"

namespace voronerf {

template void mlp_backward_launch<HalfProducts<false>>(const MlpCudaPlan&, const MlpCudaData&, const HashEncoding&,
                                                       void*);

}  // namespace voronerf
