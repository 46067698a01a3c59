"""The case of ``nearest_centre_grid``."""

from __future__ import annotations

from voronerf.ops.cases import Arguments, Case, Draw
from voronerf.ops.centre_grid import centre_grid
from voronerf.ops.nearest_centre.case import CASE as OF_ALL


def _make(draw: Draw, n: int) -> Arguments:
    call = OF_ALL.make(draw, n)
    return {**call, "grid": centre_grid(call["centres"], weights=call["weights"], backend="reference")}


CASE = Case(
    _make,
    refused={"grid must be made from these centres and weights, got that of others": {"weights": None}},
    compiles=False,
    call="nearest_centre",
)
