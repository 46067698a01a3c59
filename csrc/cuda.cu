#include "common.h"
#include "cuda.h"

namespace voronerf {

void cuda_set_device(int device) {
  VN_CUDA_CHECK(cudaSetDevice(device));
}

}  // namespace voronerf
