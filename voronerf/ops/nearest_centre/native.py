"""``nearest_centre`` of the compiled module. n points, k centres."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import rows_of


@declared("nearest_centre").custom_op()
def nearest_centre(given: Any, cells: Tensor) -> None:
    """Index of the nearest centre of every point; see ``voronerf.ops.nearest_centre``."""
    find(cells, given.points, given.centres)


def find(cells: Tensor, points: Tensor, centres: Tensor, rows: Tensor | None = None) -> None:
    """Fills ``cells``, int32 [n]; coordinates are of one dtype. On CUDA with -1 from ``rows`` on."""
    compiled, machine = native.compiled, native.machine(points)
    n, k = rows_of(points), centres.shape[0]
    if isinstance(machine, compiled.Cuda):
        compiled.nearest_centre(points, centres, rows, cells, n, k, machine)
    else:
        compiled.nearest_centre(points, centres, cells, n, k, machine)
