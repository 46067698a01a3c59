#include "encoding/adam.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(AdamRule, rate, rate_at, step, decay, decay_sq, epsilon, dense);
VN_STRUCT(AdamGuard, loss, limit, skip, skipped, in_a_row, scale);

VN_BINDINGS(module) {
  module.cpu("adam", VN_CPU(adam_cpu));
  module.cuda("adam", VN_CUDA(adam_cuda));
  module.cuda("adam_workspace", VN_CUDA(adam_workspace_cuda));
  module.cpu("average", VN_CPU(average_cpu));
}

}  // namespace voronerf
