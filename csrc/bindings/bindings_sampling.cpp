// The encodings, resample and draw_cell for Python: addresses and sizes in, the GIL released while they run.
#include "bindings/bindings_sampling.h"

#include <cstdint>

#include "encoding/encode.h"
#include "geometry/draw_cell.h"
#include "rays/resample.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

voronerf::Encoding encoding(Address x, Address variances, int64_t n, int64_t d, int64_t octaves, bool include_input) {
  const int64_t width = d * (2 * octaves + (include_input ? 1 : 0));
  return {at<const float>(x), at<const float>(variances), n, d, octaves, include_input, width};
}

// variances: 0 for the plain frequency encoding.
void encode(Address x, Address variances, Address out, Address workspace, int64_t n, int64_t d, int64_t octaves,
            bool include_input, int isa, int threads) {
  voronerf::encode_cpu(encoding(x, variances, n, d, octaves, include_input), at<float>(out), at<float>(workspace),
                       static_cast<voronerf::Isa>(isa), threads);
}

void encode_backward(Address gradient, Address x, Address variances, Address grad_x, Address grad_variances,
                     Address workspace, int64_t n, int64_t d, int64_t octaves, bool include_input, int isa,
                     int threads) {
  voronerf::encode_backward_cpu(encoding(x, variances, n, d, octaves, include_input), at<const float>(gradient),
                                at<float>(grad_x), at<float>(grad_variances), at<float>(workspace),
                                static_cast<voronerf::Isa>(isa), threads);
}

// uniforms: 0 for the midpoints of equal strata.
void resample(Address weights, Address edges, Address uniforms, Address depths, int64_t r, int64_t s, int64_t count,
              int threads) {
  voronerf::resample_cpu(at<const float>(weights), at<const float>(edges), at<const float>(uniforms), at<float>(depths),
                         r, s, count, threads);
}

bool draw_cell(Address points, Address centres, Address weights, Address child_offsets, Address child, Address uniforms,
               Address leaves, Address places, Address sums, int64_t n, int64_t m, int depth, double temperature,
               int isa, int threads) {
  return voronerf::draw_cell_cpu(at<const float>(points), at<const float>(centres), at<const float>(weights),
                                 at<const int32_t>(child_offsets), at<const int32_t>(child), at<const float>(uniforms),
                                 at<int32_t>(leaves), at<int32_t>(places), at<float>(sums), n, m, depth, temperature,
                                 static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_sampling(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("encode_workspace", &voronerf::encode_workspace);
  module.def("encode", &encode, no_gil);
  module.def("encode_backward", &encode_backward, no_gil);
  module.def("resample", &resample, no_gil);
  module.def("draw_cell", &draw_cell, no_gil);
  module.def("draw_cell_places", &voronerf::draw_cell_places);
  module.def("draw_cell_sums", &voronerf::draw_cell_sums);
}
