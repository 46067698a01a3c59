// Calls of programs (network/program.h) from Python. A call derives the other arguments of the program from its
// tensors.
#pragma once

#include <pybind11/pybind11.h>

namespace voronerf {

// Adds ProgramCall to the module.
void bind_program_calls(pybind11::module_& module);

}  // namespace voronerf
