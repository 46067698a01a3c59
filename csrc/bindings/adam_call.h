// The Adam step of Python, which checks its arguments and runs in one call.
#pragma once

#include <pybind11/pybind11.h>

namespace voronerf {

// Adds adam_step to the module.
void bind_adam_step(pybind11::module_& module);

}  // namespace voronerf
