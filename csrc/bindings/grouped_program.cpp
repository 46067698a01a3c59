#include "bindings/bind.h"
#include "network/program.h"

namespace voronerf {

VN_STRUCT(ProgramInputs, code, constants, inputs, turned, parameters, strides, widths, outputs, offsets, order, n, k);
VN_STRUCT(ProgramSizes, columns, partial, inputs, parameters, outputs, sums);

VN_BINDINGS(module) {
  module.cpu("grouped_program", VN_CPU(grouped_program_cpu));
  module.cuda("grouped_program", VN_CUDA(grouped_program_cuda));
  module.cuda("grouped_program_workspace", VN_CUDA(grouped_program_workspace_cuda));
}

}  // namespace voronerf
