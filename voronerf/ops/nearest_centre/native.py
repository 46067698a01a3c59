"""``nearest_centre`` of the compiled module. n points, k centres."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op


def nearest_centre(points: Tensor, centres: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Index of the centre with the smallest ``|x - c|^2 - w`` for every point; see ``voronerf.ops.nearest_centre``."""
    cells: Tensor = _nearest_centre(*as_compared(points, centres, weights))
    return cells


@custom_op("nearest_centre")
def _nearest_centre(points: Tensor, centres: Tensor, weights: Tensor | None) -> Iterator[Tensor]:
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    yield cells
    find(cells, points, centres, weights)


def find(cells: Tensor, points: Tensor, centres: Tensor, weights: Tensor | None) -> None:
    """Fills ``cells``, int32 [n]; coordinates and weights are of one dtype."""
    n, k = points.shape[0], centres.shape[0]
    native.compiled.nearest_centre(points, centres, weights, cells, n, k, native.machine(points))


def as_compared(points: Tensor, centres: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """One dtype for all: float64 if any is, else float32, which holds the half types exactly."""
    given = (points, centres) if weights is None else (points, centres, weights)
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in given) else torch.float32
    points, centres = points.detach().to(dtype), centres.detach().to(dtype)
    return points, centres, None if weights is None else weights.detach().to(dtype)
