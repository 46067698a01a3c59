"""``nearest_centre`` of the compiled module. n points, k centres."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op


@custom_op("nearest_centre")
def nearest_centre(points: Tensor, centres: Tensor) -> Iterator[Tensor]:
    """Index of the nearest centre of every point; see ``voronerf.ops.nearest_centre``."""
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    yield cells
    find(cells, points, centres)


def find(cells: Tensor, points: Tensor, centres: Tensor, rows: Tensor | None = None) -> None:
    """Fills ``cells``, int32 [n]; coordinates are of one dtype. On CUDA with -1 from ``rows`` on."""
    compiled, machine = native.compiled, native.machine(points)
    n, k = points.shape[0], centres.shape[0]
    if isinstance(machine, compiled.Cuda):
        compiled.nearest_centre(points, centres, rows, cells, n, k, machine)
    else:
        compiled.nearest_centre(points, centres, cells, n, k, machine)
