// How a network's positions or directions are encoded before its layers read them. Plain, for the kernels to include.
#pragma once

namespace voronerf {

enum class MlpEncodingKind : int { none = 0, frequency, integrated, hash, spherical };

// integrated: means and variances, each half of the raw features, encoded as mip-NeRF does.
struct MlpEncoding {
  MlpEncodingKind kind = MlpEncodingKind::none;
  int size = 0;  // octaves; the features of a hash grid; the degree of spherical harmonics
};

}  // namespace voronerf
