// The part of the Python module that marches rays (bindings_march.cpp).
#pragma once

#include <pybind11/pybind11.h>

void bind_march(pybind11::module_& module);
