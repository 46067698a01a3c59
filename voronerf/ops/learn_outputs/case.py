"""The case of ``learn_outputs``."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.layers import MLP, POSITIONS, Layer
from voronerf.ops.cases import Arguments, Case, Draw


def _squares(out: Tensor) -> tuple[Tensor, Tensor]:
    return out.square().sum(), 2 * out


def _make(draw: Draw, n: int) -> Arguments:
    table = MLP((Layer((POSITIONS,), 6, "relu"), Layer((0,), 4)), (1,))
    network = {"positions": draw.uniform(n, 3), "layers": table, "centres": draw.uniform(2, 3)}
    network |= {"weights": [draw.normal(2, 6, 3), draw.normal(2, 4, 6)], "biases": [draw.normal(2, 6), None]}
    return {"network": network, "loss": _squares}


CASE = Case(
    _make,
    refused={
        "loss must be a function, got int": {"loss": 3},
        "loss must return a loss [] and a gradient [6, 4], got [2] and [6, 4]": {
            "loss": lambda out: (torch.zeros(2), out)
        },
    },
    traced=False,
)
