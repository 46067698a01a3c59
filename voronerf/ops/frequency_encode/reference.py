"""The frequency encoding of NeRF. n points, d features, L octaves."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core.encodings import frequency


def frequency_encode(x: Tensor, octaves: int, include_input: bool = True) -> Tensor:
    """Returns ``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    return frequency(x, octaves)[:, 0 if include_input else x.shape[1] :]
