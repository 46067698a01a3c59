"""The integrated encoding of mip-NeRF. n Gaussians, L octaves."""

from __future__ import annotations

import torch
from torch import Tensor


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Expected encoding of a Gaussian; see ``voronerf.ops.integrated_encode``."""
    wide = torch.promote_types(means.dtype, torch.float32)
    mean, variance = means.to(wide), variances.to(wide)
    parts = [mean[:, :0]]
    for octave in range(octaves):
        angle = mean * 2.0**octave
        blur = torch.exp(-0.5 * 4.0**octave * variance)
        parts += [angle.sin() * blur, angle.cos() * blur]
    return torch.cat(parts, dim=1).to(means.dtype)
