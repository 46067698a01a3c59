"""The heaviest samples of a batch. n samples, q of them kept."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def select_heaviest(points: Tensor, importance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The samples of largest importance; see ``voronerf.ops.select_heaviest``."""
    # What is finite differs from itself by 0, the rest by NaN: less than half the time of isfinite and all.
    x, y, z = points.unbind(1)
    finite = (x - x) + (y - y) + (z - z) + (importance - importance) == 0
    valid = (importance > 0) & finite
    kept, index = torch.where(valid, importance, 0).topk(min(count, importance.shape[0]))
    return torch.where(kept[:, None] > 0, points[index], 0), kept
