// The CUDA half of voronerf._C, emulated: the bindings of csrc/bindings_cuda.cpp over .cu files compiled by g++.
#include <pybind11/pybind11.h>

#include "bindings_cuda.h"
#include "emulation.h"

namespace py = pybind11;

void planted(const float* values, float* out, int* counter, int blocks, int threads, int bug);

PYBIND11_MODULE(voronerf_emulation, module) {
  bind_cuda(module);
  module.def("planted",
             [](std::uintptr_t values, std::uintptr_t out, std::uintptr_t counter, int blocks, int threads, int bug) {
               planted(reinterpret_cast<const float*>(values), reinterpret_cast<float*>(out),
                       reinterpret_cast<int*>(counter), blocks, threads, bug);
             });
  module.def("seed", [](uint64_t seed) { vn_emulation::settings().seed = seed; });
  module.def("device", [](int capability, int shared_bytes) {
    vn_emulation::settings().capability = capability;
    vn_emulation::settings().shared = shared_bytes;
  });
}
