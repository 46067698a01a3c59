// The CUDA launchers for Python: addresses of device memory, sizes, a device and its stream in; nothing owned, the GIL
// released. Empty in a build without CUDA.
#include "bindings_cuda.h"

#ifdef VN_WITH_CUDA

#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "bindings_composite.h"
#include "launchers.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

template <typename T>
void nearest_centre_cuda(Address points, Address centres, Address weights, Address cells, int64_t n, int64_t k,
                         int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::nearest_centre_cuda(at<const T>(points), at<const T>(centres), at<const T>(weights), at<int32_t>(cells), n,
                                k, at<void>(stream));
}

template <typename T>
void locate_cell_cuda(Address points, Address centres, Address weights, Address child_offsets, Address child,
                      Address leaves, int64_t n, int64_t m, int64_t g, int depth, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::locate_cell_cuda(at<const T>(points), at<const T>(centres), at<const T>(weights),
                             at<const int32_t>(child_offsets), at<const int32_t>(child), at<int32_t>(leaves), n, m, g,
                             depth, at<void>(stream));
}

void cell_sort_cuda(Address cells, Address order, Address offsets, Address workspace, int64_t n, int64_t k, int device,
                    Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::cell_sort_cuda(at<const int32_t>(cells), at<int32_t>(order), at<int32_t>(offsets), at<int32_t>(workspace),
                           n, k, at<void>(stream));
}

using Addresses = std::vector<Address>;

void composite_cuda(const Addresses& inputs, const std::vector<int64_t>& sizes, const Addresses& results, int device,
                    Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::composite_cuda(composite_inputs(inputs, sizes), composite_outputs(results), at<void>(stream));
}

void composite_backward_cuda(const Addresses& inputs, const std::vector<int64_t>& sizes, const Addresses& incoming,
                             const Addresses& outgoing, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::composite_backward_cuda(composite_inputs(inputs, sizes), composite_gradients(incoming, outgoing),
                                    at<void>(stream));
}

void encode_cuda(Address x, Address variances, Address out, int64_t n, int64_t d, int64_t octaves, bool include_input,
                 int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::encode_cuda(at<const float>(x), at<const float>(variances), at<float>(out), n, d, octaves, include_input,
                        at<void>(stream));
}

void encode_backward_cuda(Address gradient, Address x, Address variances, Address grad_x, Address grad_variances,
                          int64_t n, int64_t d, int64_t octaves, bool include_input, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::encode_backward_cuda(at<const float>(gradient), at<const float>(x), at<const float>(variances),
                                 at<float>(grad_x), at<float>(grad_variances), n, d, octaves, include_input,
                                 at<void>(stream));
}

void resample_cuda(Address weights, Address edges, Address uniforms, Address depths, Address workspace, int64_t r,
                   int64_t s, int64_t count, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::resample_cuda(at<const float>(weights), at<const float>(edges), at<const float>(uniforms),
                          at<float>(depths), at<double>(workspace), r, s, count, at<void>(stream));
}

}  // namespace

void bind_cuda(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("nearest_centre_cuda_float32", &nearest_centre_cuda<float>, no_gil);
  module.def("nearest_centre_cuda_float64", &nearest_centre_cuda<double>, no_gil);
  module.def("locate_cell_cuda_float32", &locate_cell_cuda<float>, no_gil);
  module.def("locate_cell_cuda_float64", &locate_cell_cuda<double>, no_gil);
  module.def("cell_sort_cuda", &cell_sort_cuda, no_gil);
  module.def("composite_cuda", &composite_cuda, no_gil);
  module.def("composite_backward_cuda", &composite_backward_cuda, no_gil);
  module.def("encode_cuda", &encode_cuda, no_gil);
  module.def("encode_backward_cuda", &encode_backward_cuda, no_gil);
  module.def("resample_cuda", &resample_cuda, no_gil);
}

#endif
