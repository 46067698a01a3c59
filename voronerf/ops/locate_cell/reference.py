"""The leaf of a point in a tree of diagrams. n points, m centres of all diagrams together, g diagrams."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.formulas import in_pieces
from voronerf.ops.nearest_centre.reference import distances

_PIECE = 1 << 17
"""The number of distances that are computed at a time."""


def check_tree(child_offsets: Tensor, child: Tensor, caller: str) -> None:
    """Raises ValueError on the CPU for tables that are not a tree; see ``voronerf.ops.locate_cell``."""
    if child_offsets.device.type != "cpu" or torch.compiler.is_compiling():
        return
    if child_offsets[0] != 0 or child_offsets[-1] != len(child):
        raise ValueError(f"{caller}: child_offsets must go from 0 to the number of centres")
    if (child_offsets.diff() <= 0).any():
        raise ValueError(f"{caller}: child_offsets must increase: every diagram has a centre")
    if (child >= len(child_offsets) - 1).any():
        raise ValueError(f"{caller}: child must name a diagram (below the number of diagrams) or a leaf (negative)")


def check_leaves(leaves: Tensor, depth: int, caller: str) -> None:
    """Raises ValueError on the CPU if a point has reached no leaf after ``depth`` levels."""
    if leaves.device.type == "cpu" and not torch.compiler.is_compiling() and (leaves < 0).any():
        raise ValueError(f"{caller}: depth must be the number of levels of the tree, got {depth}, which is too few")


def locate_cell(points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, depth: int) -> Tensor:
    """Returns the leaf of every point in a tree of diagrams; see ``voronerf.ops.locate_cell``.

    Distances to all centres of the tree are computed once; on each level the centres of other diagrams are masked.
    """
    check_tree(child_offsets, child, "locate_cell")
    table = torch.arange(centres.shape[0], dtype=torch.int32, device=centres.device)
    owner = torch.searchsorted(child_offsets, table, right=True) - 1

    def run(points: Tensor) -> Tensor:
        far = distances(points, centres)
        # `state` is the diagram of a point or, if negative, its leaf.
        state = torch.zeros(points.shape[0], dtype=torch.int32, device=points.device)
        for _ in range(min(depth, child_offsets.shape[0] - 1)):  # a tree has no more levels than diagrams
            nearest = far.masked_fill(owner[None, :] != state[:, None], torch.inf).argmin(dim=1)
            state = torch.where(state < 0, state, child[nearest])
        return -state - 1

    leaves = in_pieces(run, _PIECE // centres.shape[0], points)
    check_leaves(leaves, depth, "locate_cell")
    return leaves
