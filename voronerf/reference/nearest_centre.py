"""Nearest centre, exactly. n points, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

_PIECE = 1 << 17
"""Distances evaluated at a time: 1 MiB of float64, what a core's second-level cache holds."""


def nearest_centre(points: Tensor, centres: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Index of the centre with the smallest ``|x - c|^2 - w`` for every point; see ``voronerf.ops.nearest_centre``."""
    rows = max(1, _PIECE // centres.shape[0])
    if torch.compiler.is_compiling() or points.shape[0] <= rows:
        # A compiler fuses distance and argmin, and would unroll the loop.
        return distances(points, centres, weights).argmin(dim=1).to(torch.int32)
    cells = torch.empty(points.shape[0], dtype=torch.int32, device=points.device)
    for start in range(0, points.shape[0], rows):
        piece = slice(start, start + rows)
        cells[piece] = distances(points[piece], centres, weights).argmin(dim=1)
    return cells


def distances(points: Tensor, centres: Tensor, weights: Tensor | None) -> Tensor:
    """Float64 power distances [n, k] in the direct form, whose error does not grow with the distance from the origin.

    ``x^2 - 2 x.c + c^2`` cancels: in float32 it misplaces one point in ten for a scene 100 units from the origin. What
    is not a number or overflows becomes the largest finite value, so that a non-finite point is equally far from every
    centre and the lowest index wins.
    """
    points, centres = points.detach().double(), centres.detach().double()
    total = (points[:, None, 0] - centres[None, :, 0]).square()
    for axis in (1, 2):
        total = total + (points[:, None, axis] - centres[None, :, axis]).square()
    if weights is not None:
        total = total - weights.detach().double()
    return total.nan_to_num(nan=torch.finfo(torch.float64).max)
