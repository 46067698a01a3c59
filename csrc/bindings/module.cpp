// The Python module voronerf.ops._core._C. It is not linked with torch: it reads tensors through DLPack or their Python
// methods (tensor_view.h, frame.h). Only voronerf/ops/_core/native imports it.
#include <pybind11/pybind11.h>

#include "bindings/bind.h"
#include "build_info.h"
#include "network/program_code.h"

PYBIND11_MODULE(_C, module) {
  module.attr("compiler") = VN_COMPILER;
  module.attr("openmp") = static_cast<bool>(VN_OPENMP);
  module.attr("cuda") = static_cast<bool>(VN_CUDA_BUILT);
  module.attr("cuda_outcome") = VN_CUDA_OUTCOME;
  module.attr("cuda_architectures") = VN_CUDA_ARCHITECTURES;
  module.attr("cuda_major") = VN_CUDA_MAJOR;
  module.attr("most_sources") = voronerf::kMostSources;
  module.attr("most_held") = voronerf::kMostHeld;
  voronerf::bind_all(module.ptr());
}
