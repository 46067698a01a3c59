"""The case of ``centre_grid``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    centres = draw.points(n + 1, draw.dtype(torch.float32, torch.float64))
    return {"centres": centres}


CASE = Case(
    _make,
    refused={
        "centres must have shape [k, 3], got [2]": {"centres": torch.zeros(2)},
        "centres must have values, got a tensor on the device meta": {"centres": torch.zeros(2, 3, device="meta")},
    },
    compiles=False,
    comparable=False,
)
