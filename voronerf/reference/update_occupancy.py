"""Updating an occupancy grid. x, y, z cells along each axis, q updates."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, *, decay: float, threshold: float
) -> tuple[Tensor, Tensor]:
    """The larger of the density found and the decayed old one; see ``voronerf.ops.update_occupancy``."""
    if cells.device.type == "cpu" and cells.shape[0] > 0 and not torch.compiler.is_compiling():
        low, high = (int(bound) for bound in cells.aminmax())
        if low < 0 or high >= density.numel():
            raise ValueError(
                f"update_occupancy: cells must lie in 0 to {density.numel() - 1}, got values from {low} to {high}"
            )
    flat = density.reshape(-1)
    row = cells.long()
    # A cell decays once, however often it occurs.
    faded = flat.scatter(0, row, flat[row] * decay)
    result = faded.scatter_reduce(0, row, values, "amax").reshape(density.shape)
    return result, result >= threshold
