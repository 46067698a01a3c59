#include "bindings/bind.h"
#include "encoding/adam.h"

namespace voronerf {

VN_STRUCT(SparseAdam, step_size, decay, decay_sq, epsilon, every);
VN_STRUCT(AdamRule, rate, rate_at, step, decay, decay_sq, epsilon, every);
VN_STRUCT(AdamGuard, loss, limit, found, skipped, in_a_row, scale);

VN_BINDINGS(module) {
  module.cpu("sparse_adam", VN_CPU(sparse_adam_cpu));
  module.cpu("adam", VN_CPU(adam_cpu));
  module.cuda("adam", VN_CUDA(adam_cuda));
  module.cuda("sparse_adam", VN_CUDA(sparse_adam_cuda));
}

}  // namespace voronerf
