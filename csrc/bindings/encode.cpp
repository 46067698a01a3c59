#include "encoding/encode.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(Encoding, x, variances, n, d, octaves, include_input, width);

VN_BINDINGS(module) {
  module.cpu("encode", VN_CPU(encode_cpu));
  module.cpu("encode_backward", VN_CPU(encode_backward_cpu));
  module.cpu("encode_workspace", VN_CPU(encode_workspace));
  module.cuda("encode", VN_CUDA(encode_cuda));
  module.cuda("encode_backward", VN_CUDA(encode_backward_cuda));
}

}  // namespace voronerf
