"""Draws valid arguments of ``march_rays`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.formulas import SPACINGS


def _make(draw: Draw, n: int) -> Arguments:
    dtype, samples = draw.dtype(torch.float32, torch.float64), draw.among("samples", 7, 1, 64, 130)
    sides = [draw.number("side", side, 1, 9) for side in (5, 4, 6)]
    directions = draw.unit(n, dtype)
    origins = 2 * draw.normal(n, 3, dtype=dtype) if draw.free else -directions
    call: Arguments = {"origins": origins, "directions": directions, "samples": samples}
    call |= {"near": 0.01 + draw.uniform(n, dtype=dtype), "far": 3 + draw.uniform(n, dtype=dtype)}
    call |= {"occupied": draw.uniform(*sides) < 0.4, "box": torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=dtype)}
    jitter = draw.among("jitter", "uniforms", "seed", None)
    if jitter == "uniforms":
        call["uniforms"] = draw.uniform(n, samples, dtype=dtype)
    elif jitter == "seed":
        call["seed"] = draw.integers(-(2**31), 2**31 - 1, 1)
    if draw.among("pieces", True, False):
        call |= {"start": draw.integers(0, 3, n), "max_samples": draw.number("max_samples", 5, 1, 9)}
        call["capacity"] = draw.number("capacity", 40, 1, 200)
    sphere, frustum = draw.uniform(4, dtype=dtype) + 0.1, draw.uniform(5, 3, dtype=dtype) + 0.1
    spacing = draw.among("spacing", *SPACINGS)
    return {**call, "contraction": draw.among("contraction", None, sphere, frustum), "spacing": spacing}


CASE = Case(
    _make,
    {"": {}, "by a seed": {"jitter": "seed", "spacing": "disparity"}},
    refused={
        "samples must be at most 65535, got 65536": {"samples": 65_536, "uniforms": None},
        "spacing must be one of linear, disparity, got 'x'": {"spacing": "x"},
    },
)
