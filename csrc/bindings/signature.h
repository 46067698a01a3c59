// Calls of ops from Python. One call checks the arguments and runs a compiled function, unless a part of torch has to
// see the call. The rules are read once, from the signature of the public function (voronerf/ops/_core/declare.py).
#pragma once

#include <pybind11/pybind11.h>

namespace voronerf {

// Adds TensorRules, signature, way_of and register_queries to the module.
void bind_signatures(pybind11::module_& module);

}  // namespace voronerf
