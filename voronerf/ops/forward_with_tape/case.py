"""The case of ``forward_with_tape``."""

from __future__ import annotations

from voronerf.ops._core.cases import Arguments, Case, Draw
from voronerf.ops._core.layers import MLP, POSITIONS, Layer


def _make(draw: Draw, n: int) -> Arguments:
    table = MLP((Layer((POSITIONS,), 6, "relu"), Layer((0,), 4)), (1,))
    network = {"positions": draw.uniform(n, 3), "layers": table, "centres": draw.uniform(2, 3)}
    network |= {"weights": [draw.normal(2, 6, 3), draw.normal(2, 4, 6)], "biases": [draw.normal(2, 6), None]}
    return {"network": network}


CASE = Case(
    _make,
    refused={"network must hold positions, weights, biases and layers, got 3": {"network": 3}},
    traced=False,
)
