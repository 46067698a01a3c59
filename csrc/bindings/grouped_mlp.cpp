#include "bindings/grouped_mlp.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("grouped_mlp", VN_CPU(grouped_mlp_cpu));
  module.cpu("grouped_mlp_backward", VN_CPU(grouped_mlp_backward_cpu));
}

}  // namespace voronerf
