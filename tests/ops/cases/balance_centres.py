"""Draws valid arguments of ``balance_centres`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    call: Arguments = {"samples": draw.uniform(n, 3), "masses": draw.uniform(n).double()}
    call |= {"centres": draw.uniform(draw.number("k", 3, 1, 20), 3), "steps": draw.number("steps", 2, 0, 3)}
    return {**call, "neighbours": draw.number("neighbours", 8, 1, 9)}


CASE = Case(_make, refused={"alpha must be a number, got NoneType": {"alpha": None}})
