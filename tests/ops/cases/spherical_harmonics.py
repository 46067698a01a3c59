"""Draws valid arguments of ``spherical_harmonics`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    return {"directions": draw.unit(n, draw.dtype()), "degree": draw.number("degree", 4, 1, 4)}


CASE = Case(
    _make,
    {"": {}, "constant": {"degree": 1}},
    refused={"degree must be an integer, got str": {"degree": "x"}},
    differentiable=True,
)
