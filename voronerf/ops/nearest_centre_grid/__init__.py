"""The look-up of ``nearest_centre`` by a grid. n points, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import COORDINATES, Implementation
from voronerf.ops.centre_grid import CentreGrid

_OP = backends.declare("nearest_centre_grid", native=Implementation(("cpu",), COORDINATES))


def nearest_centre_grid(points: Tensor, centres: Tensor, grid: CentreGrid, backend: str) -> Tensor:
    """What ``nearest_centre`` does with a grid, whose checks have been made."""
    if not isinstance(grid, CentreGrid):
        raise TypeError(f"nearest_centre: grid must be a CentreGrid, got {type(grid).__name__}")
    # A compiled graph cannot compare values, so it trusts the caller.
    belongs = grid.fits if torch.compiler.is_compiling() else grid.belongs_to
    if not belongs(centres):
        raise ValueError("nearest_centre: grid must be made from these centres, got that of others")
    run = backends.resolve(_OP, backend=backend, device=points.device, dtype=points.dtype)
    cells: Tensor = run(points, centres, grid.tables)
    return cells
