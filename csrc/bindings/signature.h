// Calls of ops from Python: their arguments are checked and, where nothing else has to see the call, a compiled
// function is called with them, all in one go. What they must be is said by the signature of the public function
// (voronerf/ops/_core/declare.py), which is read here once.
#pragma once

#include <pybind11/pybind11.h>

namespace voronerf {

// Adds Rules, signature, alike, way_of and know_calls to the module.
void bind_signatures(pybind11::module_& module);

}  // namespace voronerf
