"""Draws valid arguments of ``nearest_centre`` for the tests, and lists invalid arguments.

n points, k centres, d coordinates.
"""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.nearest_centre import index_centres


def _make(draw: Draw, n: int) -> Arguments:
    k, d = draw.among("k", 7, 1, 2, 9, 33, 300), draw.among("d", 3, 1, 2, 4)
    points, centres = (torch.cat([draw.points(rows, draw.dtype()) for _ in range(2)], 1)[:, :d] for rows in (n, k))
    compared = centres.to(torch.promote_types(points.dtype, centres.dtype))
    index = index_centres(compared) if draw.among("indexed", False, True) else None
    return {"points": points, "centres": centres, "index": index}


CASE = Case(
    _make,
    refused={
        "points must be a tensor, got list": {"points": [1.0]},
        "centres must have shape [k, d] with d = 3, got [1]": {"centres": torch.zeros(1)},
    },
    alternatives={"torch cdist": lambda points, centres, index: torch.cdist(points, centres).argmin(1)},
    on_devices=(
        {"k": 700},
        {"points": "lattice", "indexed": True},
        {"dtype": torch.float64},
        {"k": 700, "indexed": True},
    ),
    device_rows=120,
)
