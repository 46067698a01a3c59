"""The case of ``draw_cell``."""

from __future__ import annotations

import torch

from voronerf.ops.cases import Arguments, Case, Draw
from voronerf.ops.locate_cell.case import CASE as NEAREST


def _make(draw: Draw, n: int) -> Arguments:
    call = NEAREST.make(draw, n)
    return {
        **call,
        "uniforms": draw.uniform(n, call["depth"]),
        "temperature": draw.among("temperature", 0.3, 0.1, 100.0),
    }


CASE = Case(
    _make,
    refused={
        "temperature must be a number, got str": {"temperature": "warm"},
        "temperature must be a number, got Tensor": {"temperature": torch.ones(2)},
        "child must name a diagram, got 9": {"child": torch.full((10,), 9, dtype=torch.int32)},
        "child_offsets must increase, got a diagram without centres": {
            "child_offsets": torch.tensor([0, 3, 3, 7, 10], dtype=torch.int32)
        },
        "child_offsets must go from 0 to the number of centres, got [0, 9]": {
            "child_offsets": torch.tensor([0, 3, 5, 7, 9], dtype=torch.int32)
        },
        "depth must be the number of levels of the tree, got 3, which is too few": {
            "child": torch.zeros(10, dtype=torch.int32)
        },
        "temperature must be positive and finite, got 0.0": {"temperature": 0.0},
    },
)
