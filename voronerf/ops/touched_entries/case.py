"""The cases of ``pack_entries`` and ``add_entries``."""

from __future__ import annotations

from voronerf.ops.cases import Arguments, Case, Draw
from voronerf.ops.touched_entries import pack_entries


def _make(draw: Draw, n: int) -> Arguments:
    return {"gradient": draw.normal(n) * (draw.uniform(n) < 0.3)}


def _make_parts(draw: Draw, n: int) -> Arguments:
    return {"parts": [pack_entries(_make(draw, n)["gradient"], backend="reference") for _ in range(2)], "n": n}


CASES = {
    "pack_entries": Case(_make, traced=False),
    "add_entries": Case(
        _make_parts, refused={"parts must hold at least one message, got none": {"parts": []}}, traced=False
    ),
}
