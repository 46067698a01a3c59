"""The case of ``nearest_centre_grid``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw
from voronerf.ops.centre_grid import centre_grid
from voronerf.ops.nearest_centre.case import CASE as OF_ALL


def _make(draw: Draw, n: int) -> Arguments:
    call = OF_ALL.make(draw, n)
    return {**call, "grid": centre_grid(call["centres"], backend="reference")}


CASE = Case(
    _make,
    refused={"grid must be made from these centres, got that of others": {"centres": torch.zeros(7, 3)}},
    compiles=False,
    call="nearest_centre",
)
