"""The heaviest samples of each batch. b kept batches of q samples, m samples of a new batch, r rays, d coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range


@torch.no_grad()
def keep_heaviest(
    kept_points: Tensor,
    kept_importance: Tensor,
    added: Tensor,
    points: Tensor,
    weights: Tensor,
    error: Tensor | None,
    ray_index: Tensor | None,
) -> None:
    """Keeps the heaviest samples of a batch; see ``voronerf.ops.keep_heaviest``."""
    if error is not None and ray_index is not None:
        check_range("keep_heaviest", "ray_index", ray_index, len(error))
        weights = weights * error.index_select(0, ray_index)
    batches, quota = kept_importance.shape
    counted = weights.nan_to_num(0.0, 0.0, 0.0).clamp_min(0)
    kept, index = (part[:quota] for part in counted.sort(descending=True, stable=True))
    chosen = points.index_select(0, index)
    usable = (kept > 0) & chosen.isfinite().all(1)
    count, slot = len(kept), added % batches
    importance, places = torch.zeros_like(kept_importance[:1]), torch.zeros_like(kept_points[:1])
    importance[0, :count] = torch.where(usable, kept, 0)
    places[0, :count] = torch.where(usable[:, None], chosen, 0)
    kept_importance.index_copy_(0, slot, importance)
    kept_points.index_copy_(0, slot, places)
    added += 1
