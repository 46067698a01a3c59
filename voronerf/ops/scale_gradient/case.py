"""The case of ``scale_gradient``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    c = draw.number("c", 4, 1, 6)
    return {"gradient": draw.normal(n, c).contiguous(), "depths": 2 * draw.uniform(n), "full": 1.25}


CASE = Case(
    _make,
    refused={
        "full must be positive, got 0.0": {"full": 0.0},
        "gradient must be contiguous, got strides (1, 6)": {"gradient": torch.zeros(4, 6).T},
    },
    in_place=True,
    traced=False,
    device_rows=260,
)
