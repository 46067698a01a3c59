// The Python module voronerf.ops._core._C, which knows tensors by their dtypes and addresses alone and owns nothing.
// voronerf/ops/_core/native is its only importer, and has validated shapes and devices and allocated outputs and
// workspaces.
#include <Python.h>

#include "bindings/bind.h"
#include "build_info.h"

PyMODINIT_FUNC PyInit__C() {
  static PyModuleDef definition = {
      PyModuleDef_HEAD_INIT, "_C", nullptr, -1, nullptr, nullptr, nullptr, nullptr, nullptr};
  PyObject* const module = PyModule_Create(&definition);
  if (module == nullptr || !voronerf::bind_all(module)) return nullptr;
  PyModule_AddStringConstant(module, "compiler", VN_COMPILER);
  PyModule_AddObject(module, "openmp", PyBool_FromLong(VN_OPENMP));
  PyModule_AddObject(module, "cuda", PyBool_FromLong(VN_CUDA_BUILT));
  PyModule_AddStringConstant(module, "cuda_outcome", VN_CUDA_OUTCOME);
  PyModule_AddStringConstant(module, "cuda_architectures", VN_CUDA_ARCHITECTURES);
  PyModule_AddIntConstant(module, "cuda_major", VN_CUDA_MAJOR);
  return module;
}
