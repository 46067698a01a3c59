"""The nested query. n points, m centres of all diagrams together, g diagrams."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.nearest_centre.reference import distances, in_pieces

_PIECE = 1 << 17


def locate_cell(points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, depth: int) -> Tensor:
    """Leaf of every point in a tree of diagrams; see ``voronerf.ops.locate_cell``.

    Distances to all centres of the tree are taken once; at each level those of other diagrams are put out of reach.
    """
    table = torch.arange(centres.shape[0], dtype=torch.int32, device=centres.device)
    owner = torch.searchsorted(child_offsets, table, right=True) - 1

    def run(points: Tensor) -> Tensor:
        far = distances(points, centres)
        # `state` is the diagram a point is in, or (negative) the leaf it has reached.
        state = torch.zeros(points.shape[0], dtype=torch.int32, device=points.device)
        for _ in range(min(depth, child_offsets.shape[0] - 1)):  # a tree has no more levels than diagrams
            nearest = far.masked_fill(owner[None, :] != state[:, None], torch.inf).argmin(dim=1)
            state = torch.where(state < 0, state, child[nearest])
        return -state - 1

    return in_pieces(run, _PIECE // centres.shape[0], points)
