"""Draws valid arguments of ``integrated_encode`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    dtype = draw.dtype()
    call = {"means": draw.uniform(n, 3, dtype=dtype), "variances": draw.uniform(n, 3, dtype=dtype)}
    return {**call, "octaves": draw.among("octaves", 3, 0, 1, 10)}


CASE = Case(_make, refused={"octaves must be at most 127, got 3000": {"octaves": 3000}}, differentiable=True)
