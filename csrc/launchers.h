// The CUDA half as bindings.cpp sees it: launchers on the caller's stream (an opaque cudaStream_t), all pointers on the
// device. The same contracts as the CPU functions in <op>.h.
#pragma once

#include <cstdint>

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

template <typename T>
void nearest_centre_cuda(const T* points, const T* centres, const T* weights, int32_t* cells, int64_t n, int64_t k,
                         void* stream);

// A cell below 0 sorts before offsets[0], one from k on after offsets[k]: raising would need a host read.
void cell_sort_cuda(const int32_t* cells, int32_t* order, int32_t* offsets, int32_t* workspace, int64_t n, int64_t k,
                    void* stream);

// g diagrams. Unsound tables (locate_cell_fault) cannot be refused without a host read: a walk ends where they lead out
// of them, nothing outside is read, and a point that has reached no leaf by then, or in `depth` levels, gets a negative
// number.
template <typename T>
void locate_cell_cuda(const T* points, const T* centres, const T* weights, const int32_t* child_offsets,
                      const int32_t* child, int32_t* leaves, int64_t n, int64_t m, int64_t g, int depth, void* stream);

}  // namespace voronerf
