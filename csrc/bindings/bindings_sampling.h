// The part of the Python module that draws and encodes samples (bindings_sampling.cpp).
#pragma once

#include <pybind11/pybind11.h>

void bind_sampling(pybind11::module_& module);
