"""``integrated_encode`` of the compiled module."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core.custom_op import in_float32
from voronerf.ops.frequency_encode.autograd import Encoding
from voronerf.ops.frequency_encode.native import encode


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Expected encoding of a Gaussian; see ``voronerf.ops.integrated_encode``."""
    encoded: Tensor = in_float32(encode, Encoding(means, variances, octaves, False))
    return encoded
