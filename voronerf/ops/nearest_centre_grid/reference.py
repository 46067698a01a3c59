"""The nearest centre by a grid of candidate lists. n points, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.centre_grid.reference import BRICK_BITS, CELL_BITS, REACH, GridTables
from voronerf.ops.nearest_centre.reference import distances, nearest_centre


def nearest_centre_grid(points: Tensor, centres: Tensor, grid: GridTables) -> Tensor:
    """Index of the nearest centre of every point by the candidates of its cell; see ``voronerf.ops.nearest_centre``."""
    cells, reached = _cells(points.detach().double(), grid.frame)
    entries, lists, shift = grid.entries, grid.lists, CELL_BITS - grid.bits
    number = _slot(cells >> shift, grid.bits)
    entry = entries[number].long()
    while bool((entry < 0).any()):
        shift -= BRICK_BITS
        inside = _slot((cells >> shift) & (2**BRICK_BITS - 1), BRICK_BITS)
        entry = torch.where(entry < 0, entries[torch.where(entry < 0, -1 - entry + inside, 0)].long(), entry)
    found = torch.zeros(points.shape[0], dtype=torch.int32, device=points.device)
    # Points of one list together.
    for place in entry[reached].unique().tolist():
        rows = (reached & (entry == place)).nonzero()[:, 0]
        candidates = lists[place + 1 : place + 1 + int(lists[place])].long()
        found[rows] = candidates[distances(points[rows], centres[candidates]).argmin(dim=1)].int()
    if not bool(reached.all()):
        found[~reached] = nearest_centre(points[~reached], centres)
    return found


def _cells(points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers int64 [n, 3] of the finest cells, and whether the grid reaches a point, bool [n]."""
    middle, inverse = frame.double()
    u = (points - middle) * inverse
    reached = (u.abs() <= REACH).all(dim=1)
    u = torch.where(reached[:, None], u, 0.0)
    outside = 1 + (1 - 1 / u.abs().clamp(min=1)) / 3
    p = torch.where(u.abs() <= 1, u, u.sign() * outside)
    return ((p + 4 / 3) * 0.375 * 2**CELL_BITS).long().clamp(0, 2**CELL_BITS - 1), reached


def _slot(cells: Tensor, bits: int) -> Tensor:
    return (((cells[:, 0] << bits) + cells[:, 1]) << bits) + cells[:, 2]
