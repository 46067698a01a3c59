"""``nearest_centre`` of the compiled module. n points, k centres."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import rows_of

nearest_centre = declared("nearest_centre").compiled_op(
    "",
    "nearest_centre",
    *("points", "centres", "result", "n", "k"),
    on_cuda=lambda given, cells, _: find(cells, given.points, given.centres),
)


def find(cells: Tensor, points: Tensor, centres: Tensor, rows: Tensor | None = None) -> None:
    """Fills ``cells``, int32 [n]; coordinates are of one dtype. On CUDA with -1 from ``rows`` on."""
    compiled, machine = native.compiled, native.machine(points)
    n, k = rows_of(points), centres.shape[0]
    if isinstance(machine, compiled.Cuda):
        compiled.nearest_centre(points, centres, rows, cells, n, k, machine)
    else:
        compiled.nearest_centre(points, centres, cells, n, k, machine)
