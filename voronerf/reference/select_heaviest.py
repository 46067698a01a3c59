"""The heaviest samples of a batch. n samples, q of them kept."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def select_heaviest(points: Tensor, importance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The samples of largest importance; see ``voronerf.ops.select_heaviest``."""
    valid = (importance > 0) & torch.isfinite(importance) & torch.isfinite(points).all(1)
    kept, index = torch.where(valid, importance, 0).topk(min(count, importance.shape[0]))
    return torch.where(kept[:, None] > 0, points[index], 0), kept
