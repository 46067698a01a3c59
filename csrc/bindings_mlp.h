// The part of the Python module that runs whole networks (bindings_mlp.cpp).
#pragma once

#include <pybind11/pybind11.h>

void bind_mlp(pybind11::module_& module);
