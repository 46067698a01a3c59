#include "network/grouped_linear.h"

#include "bindings/grouped_mlp.h"

namespace voronerf {

VN_STRUCT(LinearInputs, x, offsets, weight, bias, n, k, i, o, activation, bfloat16);
VN_STRUCT(LinearGradients, out, x, weight, bias);

VN_BINDINGS(module) {
  module.cpu("grouped_linear", VN_CPU(grouped_linear_cpu));
  module.cpu("grouped_linear_backward", VN_CPU(grouped_linear_backward_cpu));
}

}  // namespace voronerf
