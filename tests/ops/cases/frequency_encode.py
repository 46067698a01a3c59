"""Draws valid arguments of ``frequency_encode`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    x = draw.normal(n, draw.among("features", 3, 1, 2, 7), dtype=draw.dtype())
    return {"x": x, "octaves": draw.among("octaves", 4, 0, 1, 10), "include_input": draw.among("itself", True, False)}


CASE = Case(
    _make,
    {"": {}, "itself": {"octaves": 0}, "nothing": {"octaves": 0, "itself": False}},
    refused={
        "octaves must be at most 127, got 3000": {"octaves": 3000},
        "include_input must be True or False, got list": {"include_input": [1]},
    },
    differentiable=True,
)
