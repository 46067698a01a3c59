// The part of the Python module that builds and asks centre grids (bindings_grid.cpp).
#pragma once

#include <pybind11/pybind11.h>

void bind_grid(pybind11::module_& module);
