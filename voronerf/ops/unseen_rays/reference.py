"""Pairs of rays from where no camera was. r rays."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.march_rays.reference import hashed_uniforms

#: Numbers of a ray that `draw_pixels` makes of the same seed.
BEFORE = 5


@torch.no_grad()
def unseen_rays(origins: Tensor, directions: Tensor, seed: Tensor, pairs: int, move: float, tilt: float) -> None:
    """Moves the last rays; see ``voronerf.ops.unseen_rays``."""
    first, second = (slice(len(origins) - count, len(origins) - count + pairs) for count in (2 * pairs, pairs))
    numbers = 2 * hashed_uniforms(seed, len(origins), BEFORE + 6)[first, BEFORE:].to(origins) - 1
    origins[first] += move * numbers[:, :3]
    origins[second] = origins[first]
    directions[second] = torch.nn.functional.normalize(directions[first] + tilt * numbers[:, 3:], dim=1)
