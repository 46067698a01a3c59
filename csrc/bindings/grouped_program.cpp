#include "bindings/bind.h"
#include "network/program.h"

namespace voronerf {

VN_STRUCT(ProgramInputs, code, constants, inputs, turned, parameters, strides, widths, outputs, offsets, order, n, k);

VN_BINDINGS(module) {
  module.cpu("grouped_program", VN_CPU(grouped_program_cpu));
}

}  // namespace voronerf
