#include "common/common.h"
#include "common/cuda_device.h"

namespace voronerf {

CudaDevice::CudaDevice(int device) : device_(device), before_(device) {
  VN_CUDA_CHECK(cudaGetDevice(&before_));
  if (before_ != device_) VN_CUDA_CHECK(cudaSetDevice(device_));
}

CudaDevice::~CudaDevice() {
  if (before_ != device_) cudaSetDevice(before_);  // unchecked: a destructor must not throw
}

}  // namespace voronerf
