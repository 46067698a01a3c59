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
        "temperature must be positive and finite, got 0.0": {"temperature": 0.0},
    },
)
