// The CUDA half as bindings.cpp sees it: launchers on the caller's stream (an opaque cudaStream_t), all pointers on the
// device. The same contracts as the CPU functions in <op>.h.
#pragma once

#include <cstdint>

#include "geometry/cell_sort.h"
#include "rays/composite.h"

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
// The workspace's size depends on the current device and is known to the host; aligned as torch's allocations are.
int64_t cell_sort_workspace_cuda(int64_t n, int64_t k, CellSortWay way);
void cell_sort_cuda(const int32_t* cells, int32_t* order, int32_t* offsets, unsigned char* workspace, int64_t n,
                    int64_t k, CellSortWay way, void* stream);

// g diagrams. Unsound tables (locate_cell_fault) cannot be refused without a host read: a walk ends where they lead out
// of them, nothing outside is read, and a point that has reached no leaf by then, or in `depth` levels, gets a negative
// number.
template <typename T>
void locate_cell_cuda(const T* points, const T* centres, const T* weights, const int32_t* child_offsets,
                      const int32_t* child, int32_t* leaves, int64_t n, int64_t m, int64_t g, int depth, void* stream);

// uniforms [n,depth]. Of unsound tables what locate_cell_cuda says.
void draw_cell_cuda(const float* points, const float* centres, const float* weights, const int32_t* child_offsets,
                    const int32_t* child, const float* uniforms, int32_t* leaves, int64_t n, int64_t m, int64_t g,
                    int depth, double temperature, void* stream);

// Encodings (encode.h); variances and grad_variances are null for the plain one.
void encode_cuda(const float* x, const float* variances, float* out, int64_t n, int64_t d, int64_t octaves,
                 bool include_input, void* stream);
void encode_backward_cuda(const float* gradient, const float* x, const float* variances, float* grad_x,
                          float* grad_variances, int64_t n, int64_t d, int64_t octaves, bool include_input,
                          void* stream);

// workspace: r s doubles.
void resample_cuda(const float* weights, const float* edges, const float* uniforms, float* depths, double* workspace,
                   int64_t r, int64_t s, int64_t count, void* stream);

// Offsets that fall or exceed m are not refused: samples outside are not touched.
void composite_cuda(const CompositeInputs& in, const CompositeOutputs& out, void* stream);
void composite_backward_cuda(const CompositeInputs& in, const CompositeGradients& gradients, void* stream);

}  // namespace voronerf
