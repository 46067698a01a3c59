"""Triples of neighbouring rays from positions without a camera. r rays."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.march_rays.reference import hashed_uniforms

#: BEFORE: the number of hashes per ray that `draw_pixels` computes from the same seed. This op uses later hashes.
#: OCTAVES: the number of octaves over which the angles to the neighbours are distributed.
BEFORE, OCTAVES = 5, 4.0


@torch.no_grad()
def unseen_rays(origins: Tensor, directions: Tensor, seed: Tensor, triples: int, move: float, tilt: float) -> None:
    """Replaces the last rays by triples of neighbouring rays; see ``voronerf.ops.unseen_rays``."""
    begin = len(origins) - 3 * triples
    middle, one, other = (slice(begin + i * triples, begin + (i + 1) * triples) for i in range(3))
    numbers = hashed_uniforms(seed, len(origins), BEFORE + 7)[middle, BEFORE:].to(origins)
    signed, tilts = 2 * numbers[:, :6] - 1, tilt * torch.exp2(-OCTAVES * numbers[:, 6:])
    origins[middle] += move * signed[:, :3]
    origins[one] = origins[other] = origins[middle]
    ahead, aside = directions[middle], tilts * signed[:, 3:]
    aside = aside - (aside * ahead).sum(1, keepdim=True) * ahead
    directions[one] = torch.nn.functional.normalize(ahead + aside, dim=1)
    directions[other] = torch.nn.functional.normalize(ahead - aside, dim=1)
