"""The nested query. n points, m centres of all diagrams together, g diagrams."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.reference.nearest_centre import distances

_PIECE = 1 << 17


def locate_cell(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, *, depth: int, weights: Tensor | None = None
) -> Tensor:
    """Leaf of every point in a tree of diagrams; see ``voronerf.ops.locate_cell``.

    Distances to all centres of the tree are taken once; at each level those of other diagrams are put out of reach.
    """
    rows = max(1, _PIECE // centres.shape[0])
    if torch.compiler.is_compiling() or points.shape[0] <= rows:
        return _locate(points, centres, child_offsets, child, depth, weights)
    leaves = torch.empty(points.shape[0], dtype=torch.int32, device=points.device)
    for start in range(0, points.shape[0], rows):
        piece = slice(start, start + rows)
        leaves[piece] = _locate(points[piece], centres, child_offsets, child, depth, weights)
    return leaves


def _locate(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, depth: int, weights: Tensor | None
) -> Tensor:
    table = torch.arange(centres.shape[0], dtype=torch.int32, device=centres.device)
    owner = torch.searchsorted(child_offsets, table, right=True) - 1
    far = distances(points, centres, weights)
    # `state` is the diagram a point is in, or (negative) the leaf it has reached.
    state = torch.zeros(points.shape[0], dtype=torch.int32, device=points.device)
    for _ in range(depth):
        nearest = far.masked_fill(owner[None, :] != state[:, None], torch.inf).argmin(dim=1)
        state = torch.where(state < 0, state, child[nearest])
    return -state - 1
