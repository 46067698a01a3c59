#include "encoding/encode.h"

#include "bindings/program.h"

namespace voronerf {

VN_STRUCT(Encoding, encoding, n, width, x, variances, d, size, include_input);

VN_BINDINGS(module) {
  module.cpu("encode", VN_CPU(encode_cpu));
  module.cpu("encode_backward", VN_CPU(encode_backward_cpu));
  module.cuda("encode", VN_CUDA(encode_cuda));
  module.cuda("encode_backward", VN_CUDA(encode_backward_cuda));
}

}  // namespace voronerf
