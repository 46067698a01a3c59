"""The case of ``select_heaviest``."""

from __future__ import annotations

from voronerf.ops.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    return {"points": draw.uniform(n, 3), "importance": draw.uniform(n), "count": draw.number("count", 4, 1, 50)}


CASE = Case(_make, refused={"count must be at least 1, got 0": {"count": 0}})
