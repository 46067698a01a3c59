// The structs of grouped_mlp as Python passes them.
#pragma once

#include "bindings/hash_encode.h"
#include "network/grouped_mlp.h"

namespace voronerf {

VN_NAMES(Activation, "none", "relu", "softplus", "sigmoid", "sine");
VN_NAMES(MlpCaller, "grouped_mlp", "grouped_linear", "routed_mlp");
VN_STRUCT(MlpLayer, width, activation, inputs);
VN_NAMES(MlpEncodingKind, "none", "frequency", "integrated", "hash", "spherical");
VN_STRUCT(MlpEncoding, kind, size);
VN_STRUCT(MlpTable, layers, outputs, positions, directions, position, direction, grid, half, caller);
VN_STRUCT(MlpInputs, positions, directions, direction_index, offsets, weights, biases, n, r, k, order, features,
          features_type, tables, encoded);
VN_STRUCT(MlpGradients, output, weights, biases, positions, directions, features);

}  // namespace voronerf
