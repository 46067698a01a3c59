"""Updating an occupancy grid. x, y, z cells along each axis, q updates."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.checks import check_range


@torch.no_grad()
def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float
) -> tuple[Tensor, Tensor]:
    """The larger of the density found and the decayed old one; see ``voronerf.ops.update_occupancy``."""
    check_range("update_occupancy", "cells", cells, density.numel())
    flat = density.reshape(-1)
    row = cells.long()
    # A cell decays once, however often it occurs.
    faded = flat.scatter(0, row, flat[row] * decay)
    result = faded.scatter_reduce(0, row, values, "amax").reshape(density.shape)
    return result, result >= threshold
