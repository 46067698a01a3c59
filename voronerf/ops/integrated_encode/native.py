"""``integrated_encode`` of the compiled module."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops.frequency_encode.native import encode


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Expected encoding of a Gaussian; see ``voronerf.ops.integrated_encode``."""
    encoded: Tensor = encode(means.float(), variances.float(), octaves, False)
    return encoded.to(means.dtype)
