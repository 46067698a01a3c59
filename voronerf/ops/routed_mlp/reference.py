"""The whole route: locate, sort, run every sample through the network of its cell, put the results back in order.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams, p and q features of a position and a
direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.checks import check_range
from voronerf.ops._core.layers import MLP
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.grouped_mlp import grouped_mlp
from voronerf.ops.grouped_mlp.reference import check_direction_index
from voronerf.ops.locate_cell import locate_cell
from voronerf.ops.nearest_centre import nearest_centre


class Where(NamedTuple):
    """What tells the cells, as ``voronerf.ops.routed_mlp`` takes it."""

    centres: Tensor | None = None
    child_offsets: Tensor | None = None
    child: Tensor | None = None
    depth: int = 1
    cells: Tensor | None = None
    coords: Tensor | None = None
    rows: Tensor | None = None


def routed_mlp(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
    backend: str = "reference",
    **where: Any,
) -> tuple[Tensor, Tensor]:
    """Output [n, out] in the order of the positions, and the cells; see ``voronerf.ops.routed_mlp``.

    ``backend`` is that of the operations it is made of.
    """
    places = Where(**where)
    k, n = weights[0].shape[0], positions.shape[0]
    check_direction_index("routed_mlp", directions, direction_index)
    read: dict[str, Any] = {"layers": layers, "directions": directions, "direction_index": direction_index}
    read |= {"features": features, "backend": backend}
    cells = find_cells(places, k, backend)
    if cells is None:
        offsets = torch.tensor([0, n], dtype=torch.int32, device=positions.device)
        out = grouped_mlp(positions, offsets, weights, biases, **read)
        return first_rows(out, torch.zeros(n, dtype=torch.int32, device=positions.device), places.rows)
    order, offsets = cell_sort(cells, k, backend=backend)
    if direction_index is not None:
        read["direction_index"] = direction_index[order]
    elif directions is not None:
        read["directions"] = directions[order]
    out = grouped_mlp(positions[order], offsets, weights, biases, **read)
    # The backward of index_copy is a gather, where that of an index would be a scatter that adds.
    return first_rows(torch.zeros_like(out).index_copy(0, order.long(), out), cells, places.rows)


def find_cells(where: Where, k: int, backend: str) -> Tensor | None:
    """int32 [n], the cells of samples; None where there is one."""
    centres, child_offsets, child, depth, cells, coords, _ = where
    if cells is None and k == 1:
        return None
    if cells is None:
        assert coords is not None and centres is not None
        if child_offsets is None or child is None:
            cells = nearest_centre(coords, centres, backend=backend)
        else:
            cells = locate_cell(coords, centres, child_offsets, child, depth=depth, backend=backend)
    check_range("routed_mlp", "cells", cells, k)
    return cells


def first_rows(out: Tensor, cells: Tensor, rows: Tensor | None) -> tuple[Tensor, Tensor]:
    """Outputs and cells of the first ``rows``, int32 [1] or None for all; the others are 0, and in no cell: -1."""
    if rows is None:
        return out, cells
    beyond = torch.arange(cells.shape[0], device=cells.device) >= rows
    return out.masked_fill(beyond[:, None], 0), cells.masked_fill(beyond, -1)


# A compiler that traces this finds only the implementations that are loaded before.
for _op in ("nearest_centre", "locate_cell", "cell_sort", "grouped_mlp"):
    backends.chosen(_op, torch.device("cpu"), torch.float32, backend="reference")
