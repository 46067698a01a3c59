"""Updating an occupancy grid from rendered samples. x, y, z voxels along each axis, m samples."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.formulas import voxels_of


@torch.no_grad()
def observe_occupancy(*arguments: Any) -> None:
    """Updates the voxels of the samples; see ``voronerf.ops.observe_occupancy``."""
    density, occupied, box, positions, sigma, deltas, weights, decay, threshold, hidden, contraction, fixed = arguments
    observed = sigma.nan_to_num(nan=float("inf"), posinf=float("inf"))
    rows = voxels_of(positions, box, density.shape).long()
    count = density.numel()
    # Ignored samples go to one additional voxel.
    if fixed is not None:
        rows = torch.where(fixed.reshape(-1)[rows], count, rows)
    if deltas is not None:
        # weight = transmittance * opacity of the sample
        lit = weights > hidden * -torch.expm1(-observed * deltas)
        rows = torch.where(deltas != 0, rows, count)
        observed = torch.where(lit, observed, 0)
    faded, marked = (torch.nn.functional.pad(table.view(-1), (0, 1)) for table in (density, occupied))
    # A voxel decays once, for any number of samples.
    faded = faded.scatter(0, rows, faded[rows] * decay)
    if contraction is not None:
        observed = observed * stretch(positions, contraction)
    raised = faded.scatter_reduce(0, rows, observed, "amax")
    marked[rows] = raised[rows] >= threshold
    density.view(-1).copy_(raised[:count])
    occupied.view(-1).copy_(marked[:count])


def stretch(points: Tensor, contraction: Tensor) -> Tensor:
    """Returns [n], the world length per contracted length at points [n, 3]; see ``voronerf.nerf.Contraction``."""
    if contraction.dim() == 1:
        x, y, z = (points - contraction[:3]).unbind(1)
        length = (x * x + y * y + z * z).sqrt() / contraction[3]
        return (2 - length).nan_to_num(0).clamp(1e-3, 1).square().reciprocal()
    return 2 * contraction[4, 0] / (1 - points[:, 2]).nan_to_num(0).clamp_min(1e-3).square()
