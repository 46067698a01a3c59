"""The case of ``nearest_centre``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    k = draw.among("k", 7, 1, 2, 9, 33, 300)
    centres = draw.points(k, draw.dtype())
    return {"points": draw.points(n, draw.dtype()), "centres": centres}


CASE = Case(
    _make,
    refused={
        "points must be a tensor, got list": {"points": [1.0]},
        "centres must have shape [k, 3], got [1]": {"centres": torch.zeros(1)},
    },
    alternatives={"torch cdist": lambda points, centres: torch.cdist(points, centres).argmin(1)},
    on_devices=({"k": 700}, {"points": "lattice"}, {"dtype": torch.float64}),
    device_rows=260,
)
