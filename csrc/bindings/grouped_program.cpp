#include "bindings/program.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.plain("make_program", &make_program);
  module.cpu("grouped_program", VN_CPU(grouped_program_cpu));
  module.cuda("grouped_program", VN_CUDA(grouped_program_cuda));
  module.cuda("multiplies_halves", VN_CUDA(multiplies_halves_cuda));
  module.cuda("grouped_program_workspace", VN_CUDA(grouped_program_workspace_cuda));
  module.plain("program_code_bytes", VN_CUDA(program_code_bytes_cuda));
  module.plain("program_code", VN_CUDA(program_code_cuda));
}

}  // namespace voronerf
