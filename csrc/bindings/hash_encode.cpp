#include "encoding/hash_encode.h"

#include "bindings/bind.h"

namespace voronerf {

VN_NAMES(TableType, "float32", "bfloat16", "float16");
VN_STRUCT(GridLevel, scale, shift, side, entries, offset, hashed);
VN_STRUCT(HashGrid, levels, low, high, features, smooth);
VN_STRUCT(HashInputs, positions, direction, table, type, cells, n, tables, entries);

VN_BINDINGS(module) {
  module.cpu("hash_encode", VN_CPU(hash_encode_cpu));
  module.cpu("hash_encode_backward", VN_CPU(hash_encode_backward_cpu));
  module.cuda("hash_encode", VN_CUDA(hash_encode_cuda));
  module.cuda("hash_encode_backward", VN_CUDA(hash_encode_backward_cuda));
}

}  // namespace voronerf
