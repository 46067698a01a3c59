"""``nearest_centre`` with a centre grid, of the compiled module. n points, k centres."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops.centre_grid.reference import GridTables


@custom_op("nearest_centre_grid", devices=("cpu",))
def nearest_centre_grid(points: Tensor, centres: Tensor, grid: GridTables) -> Iterator[Tensor]:
    """Index of the nearest centre by the candidates of a point's cell; see ``voronerf.ops.nearest_centre``."""
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    yield cells
    n, k = points.shape[0], centres.shape[0]
    given = native.compiled.CentreGrid(**grid._asdict())
    native.compiled.nearest_centre_grid(points, centres, given, cells, n, k, native.cpu())
