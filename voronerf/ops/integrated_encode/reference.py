"""The integrated encoding of mip-NeRF. n Gaussians, L octaves."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core.encodings import integrated


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Returns the expected encoding of Gaussians; see ``voronerf.ops.integrated_encode``."""
    return integrated(torch.cat([means, variances], dim=1), octaves)
