"""Draws valid arguments of ``resample`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    dtype = draw.dtype(torch.float32, torch.float64)
    s, count = draw.among("s", 5, 1, 7, 8, 33), draw.among("count", 8, 1, 5, 16, 33)
    edges = (draw.uniform(n, s + 1, dtype=dtype) + 0.01).cumsum(1)
    uniforms = draw.uniform(n, count, dtype=dtype) if draw.among("jittered", True, False) else None
    return {"weights": draw.uniform(n, s, dtype=dtype) + 0.01, "edges": edges, "count": count, "uniforms": uniforms}


CASE = Case(
    _make,
    {"": {}, "even": {"jittered": False}},
    refused={"count must be at least 1, got 0": {"count": 0}},
    hostile="numbers",
)
