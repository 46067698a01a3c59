// A step of Adam from Python, checked and made in one go.
#pragma once

#include <pybind11/pybind11.h>

namespace voronerf {

// Adds adam_step to the module.
void bind_adam_step(pybind11::module_& module);

}  // namespace voronerf
