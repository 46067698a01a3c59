// The structs of hash_encode as Python passes them.
#pragma once

#include "bindings/bind.h"
#include "encoding/hash_encode.h"

namespace voronerf {

VN_NAMES(TableType, "float32", "bfloat16", "float16");
VN_STRUCT(GridLevel, scale, shift, side, entries, offset, hashed);
VN_STRUCT(HashGrid, levels, low, high, features);
VN_STRUCT(HashInputs, positions, direction, table, type, cells, n, tables, entries);

}  // namespace voronerf
