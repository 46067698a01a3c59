"""Updating an occupancy grid from rendered samples. x, y, z cells along each axis, m samples."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.formulas import voxels_of


@torch.no_grad()
def observe_occupancy(*given: Any) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    density, occupied, box, positions, sigma, deltas, weights, decay, threshold, hidden, contraction, fixed = given
    found = sigma.nan_to_num(nan=float("inf"), posinf=float("inf"))
    rows = voxels_of(positions, box, density.shape).long()
    count = density.numel()
    # One cell more, for samples that say nothing.
    if fixed is not None:
        rows = torch.where(fixed.reshape(-1)[rows], count, rows)
    if deltas is not None:
        # weight = light that arrives * share of it that is taken
        seen = weights > hidden * -torch.expm1(-found * deltas)
        rows = torch.where(deltas != 0, rows, count)
        found = torch.where(seen, found, 0)
    faded, marked = (torch.nn.functional.pad(table.view(-1), (0, 1)) for table in (density, occupied))
    # A cell decays once, however often it occurs.
    faded = faded.scatter(0, rows, faded[rows] * decay)
    if contraction is not None:
        found = found * stretch(positions, contraction)
    raised = faded.scatter_reduce(0, rows, found, "amax")
    marked[rows] = raised[rows] >= threshold
    density.view(-1).copy_(raised[:count])
    occupied.view(-1).copy_(marked[:count])


def stretch(points: Tensor, contraction: Tensor) -> Tensor:
    """World length of a unit of contracted length [n] at points [n, 3]; see ``voronerf.nerf.Contraction``."""
    if contraction.dim() == 1:
        x, y, z = (points - contraction[:3]).unbind(1)
        length = (x * x + y * y + z * z).sqrt() / contraction[3]
        return (2 - length).nan_to_num(0).clamp(1e-3, 1).square().reciprocal()
    return 2 * contraction[4, 0] / (1 - points[:, 2]).nan_to_num(0).clamp_min(1e-3).square()
