"""``nearest_centre`` with a centre grid, of the compiled module. n points, k centres."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op
from voronerf.ops.centre_grid.reference import GridTables


def nearest_centre_grid(points: Tensor, centres: Tensor, grid: GridTables, *, weights: Tensor | None = None) -> Tensor:
    """Index of the nearest centre by the candidates of a point's cell; see ``voronerf.ops.nearest_centre``."""
    cells: Tensor = _nearest_centre_grid(points, centres, weights, *grid)
    return cells


@custom_op("nearest_centre_grid", devices=("cpu",))
def _nearest_centre_grid(
    points: Tensor,
    centres: Tensor,
    weights: Tensor | None,
    frame: Tensor,
    entries: Tensor,
    lists: Tensor,
    table: Tensor,
    bits: int,
) -> Iterator[Tensor]:
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    yield cells
    n, k = points.shape[0], centres.shape[0]
    grid = native.compiled.CentreGrid(frame=frame, entries=entries, lists=lists, table=table, bits=bits)
    native.compiled.nearest_centre_grid(points, centres, weights, grid, cells, n, k, native.cpu())
