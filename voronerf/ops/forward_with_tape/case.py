"""The case of ``forward_with_tape``."""

from __future__ import annotations

from voronerf.ops._core.cases import Arguments, Case, Draw
from voronerf.ops._core.layers import MLP, POSITIONS, Layer


def _make(draw: Draw, n: int) -> Arguments:
    table = MLP((Layer((POSITIONS,), 6, "relu"), Layer((0,), 4)), (1,))
    network = {"positions": draw.uniform(n, 3), "layers": table, "centres": draw.uniform(2, 3)}
    weights, biases = [draw.normal(2, 6, 3), draw.normal(2, 4, 6)], [draw.normal(2, 6), None]
    if draw.among("network", "table", "program") == "program":
        program = table.program(3, 0, None, (True, False))
        parameters = [*weights, biases[0]]
        inputs = [network["positions"]]
        return {
            "network": {"program": program, "inputs": inputs, "parameters": parameters, "centres": network["centres"]}
        }
    network |= {"weights": weights, "biases": biases}
    return {"network": network}


CASE = Case(
    _make,
    {"": {}, "program": {"network": "program"}},
    refused={"network must hold positions, weights, biases and layers, got 3": {"network": 3}},
    traced=False,
)
