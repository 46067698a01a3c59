// What a Python module of bindings consists of: voronerf.ops._core._C, and the emulated CUDA half of the tests.
#pragma once

#include <cstdint>

#include "bindings/bind.h"

namespace voronerf {

// CRC-32 as in zlib.
inline uint32_t checksum(const std::string& text) {
  uint32_t sum = ~0u;
  for (const char letter : text) {
    sum ^= static_cast<unsigned char>(letter);
    for (int bit = 0; bit < 8; ++bit) sum = sum >> 1 ^ ((sum & 1) != 0 ? 0xEDB88320u : 0u);
  }
  return ~sum;
}

constexpr const char* kStub =
    "# The compiled module, written by its build from what csrc/bindings binds; the checksum is its interface.\n"
    "# A comment has the exact types of the C++ function, whose parameters these are. A tensor is contiguous, or "
    "becomes\n"
    "# so where it is const; None is a null pointer.\n"
    "from collections.abc import Sequence\n"
    "from typing import NamedTuple, overload\n"
    "\n"
    "import torch\n"
    "from torch import Tensor\n"
    "\n"
    "interface: int\n"
    "stub: str\n"
    "compiler: str\n"
    "openmp: bool\n"
    "cuda: bool\n"
    "cuda_outcome: str\n"
    "cuda_architectures: str\n"
    "cuda_major: int\n"
    "\n"
    "def name_dtypes(names: dict[str, torch.dtype]) -> None: ...\n";

inline void bind_all(py::module_& python) {
  Module module(python);
  for (const auto bind : bindings()) bind(module);
  const std::string text = kStub + module.stub();
  python.attr("stub") = text;
  python.attr("interface") = checksum(text);
  // The dtypes of tensors, objects of Python that this module knows by name alone.
  python.def("name_dtypes", [](const py::dict& names) {
    for (const auto& entry : names) {
      dtypes()[py::cast<std::string>(entry.first)] = py::reinterpret_borrow<py::object>(entry.second).release().ptr();
    }
  });
}

}  // namespace voronerf
