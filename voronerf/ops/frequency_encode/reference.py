"""The frequency encoding of NeRF. n points, d features, L octaves."""

from __future__ import annotations

import torch
from torch import Tensor


def frequency_encode(x: Tensor, octaves: int, include_input: bool = True) -> Tensor:
    """``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    wide = x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
    parts = [wide if include_input else wide[:, :0]]
    for octave in range(octaves):
        angle = wide * 2.0**octave
        parts += [angle.sin(), angle.cos()]
    return torch.cat(parts, dim=1).to(x.dtype)
