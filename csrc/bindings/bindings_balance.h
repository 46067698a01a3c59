// The part of the Python module that balances diagrams (bindings_balance.cpp).
#pragma once

#include <pybind11/pybind11.h>

void bind_balance(pybind11::module_& module);
