#include "bindings/bind.h"
#include "encoding/adam.h"

namespace voronerf {

VN_STRUCT(SparseAdam, step_size, decay, decay_sq, epsilon, every);

VN_BINDINGS(module) {
  module.cpu("sparse_adam", VN_CPU(sparse_adam_cpu));
  module.cpu("adam", VN_CPU(adam_cpu));
  module.cuda("sparse_adam", VN_CUDA(sparse_adam_cuda));
}

}  // namespace voronerf
