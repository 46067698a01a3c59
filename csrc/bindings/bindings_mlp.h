// Parts of the Python module with a file of their own: whole networks (bindings_mlp.cpp), volume rendering
// (bindings_composite.cpp).
#pragma once

#include <pybind11/pybind11.h>

void bind_mlp(pybind11::module_& module);
void bind_composite(pybind11::module_& module);
