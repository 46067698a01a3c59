// The Adam step for Python: one call checks the arguments and runs the step.
#pragma once

#include <pybind11/pybind11.h>

namespace voronerf {

// Adds adam_step to the module.
void bind_adam_step(pybind11::module_& module);

}  // namespace voronerf
