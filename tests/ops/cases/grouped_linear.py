"""Draws valid arguments of ``grouped_linear`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops._core.layers import ACTIVATIONS


def _make(draw: Draw, n: int) -> Arguments:
    k, i, o = draw.among("k", 3, 1, 2, 17), draw.among("inputs", 7, 1, 16, 33), draw.among("outputs", 5, 1, 16, 33)
    dtype = draw.dtype()
    bias = draw.normal(k, o, dtype=dtype) if draw.among("biased", True, False) else None
    weight = draw.normal(k, o, i, dtype=torch.float64) / i**0.5
    call = {
        "x": draw.normal(n, i, dtype=dtype),
        "offsets": draw.offsets(n, k),
        "weight": weight.to(dtype),
        "bias": bias,
    }
    return {**call, "activation": draw.among("activation", "sigmoid", *ACTIVATIONS)}


CASE = Case(_make, refused={"weight must be a tensor, got int": {"weight": 3}}, differentiable=True)
