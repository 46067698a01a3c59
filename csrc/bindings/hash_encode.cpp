#include "bindings/hash_encode.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("hash_encode", VN_CPU(hash_encode_cpu));
  module.cpu("hash_encode_backward", VN_CPU(hash_encode_backward_cpu));
  module.cuda("hash_encode", VN_CUDA(hash_encode_cuda));
  module.cuda("hash_encode_backward", VN_CUDA(hash_encode_backward_cuda));
}

}  // namespace voronerf
