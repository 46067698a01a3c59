"""Draws valid arguments of ``forward_with_tape`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw
from voronerf.ops._core.layers import MLP, POSITIONS, Layer


def _make(draw: Draw, n: int) -> Arguments:
    table = MLP((Layer((POSITIONS,), 6, "relu"), Layer((0,), 4)), (1,))
    program, inputs, centres = table.program(3, 0, None, (True, False)), [draw.uniform(n, 3)], draw.uniform(2, 3)
    parameters = [draw.normal(2, 6, 3), draw.normal(2, 4, 6), draw.normal(2, 6)]
    return {"network": {"program": program, "inputs": inputs, "parameters": parameters, "centres": centres}}


CASE = Case(
    _make,
    {"": {}},
    refused={"network must hold program, inputs and parameters, got 3": {"network": 3}},
    traced=False,
)
