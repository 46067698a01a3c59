// The device that a CUDA call is for.
#pragma once

namespace voronerf {

// Makes a device current for this thread while it lives, so that launches go where the caller's stream is. The static
// runtime here and torch's own share the driver's contexts, and with them what is current: it is put back.
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
