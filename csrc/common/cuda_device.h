// The current device of a CUDA call.
#pragma once

namespace voronerf {

// A scope in which a device is the current one of this thread, so that kernels are launched on the device of the
// caller's stream. The destructor restores the previous device: this static CUDA runtime and torch's own share the
// driver's contexts, hence the current device.
class CudaDevice {
 public:
  explicit CudaDevice(int device);
  ~CudaDevice();
  CudaDevice(const CudaDevice&) = delete;
  CudaDevice& operator=(const CudaDevice&) = delete;

 private:
  int device_, before_;
};

}  // namespace voronerf
