"""Draws valid arguments of ``locate_cell`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw

# Diagram 0 has three centres. Diagrams 1 and 2 refine its last two; diagram 3 refines a centre of diagram 2.
_OFFSETS = torch.tensor([0, 3, 5, 7, 10], dtype=torch.int32)
_CHILD = torch.tensor([-1, 1, 2, -2, -3, -4, 3, -5, -6, -7], dtype=torch.int32)


def tree(draw: Draw) -> tuple[Arguments, int]:
    """Draws the tables of a tree of diagrams; returns them and the number of leaves."""
    if not draw.free:
        return {"centres": draw.uniform(10, 3), "child_offsets": _OFFSETS, "child": _CHILD, "depth": 3}, 7
    counts: list[int] = []
    child: list[int] = []
    depth, level, diagrams, leaves = draw.number("depth", 3, 1, 3), 1, 1, 0
    for below in range(depth - 1, -1, -1):
        refined = 0
        for _ in range(level):
            counts.append(draw.number("width", 3, 1, 9))
            for centre in range(counts[-1]):
                if below and (draw.among("refined", False, False, True) or (centre == 0 and refined == 0)):
                    child.append(diagrams)
                    diagrams, refined = diagrams + 1, refined + 1
                else:
                    leaves += 1
                    child.append(-leaves)
        level = refined
    offsets = torch.tensor([0, *counts]).cumsum(0).to(torch.int32)
    tables = {"centres": draw.normal(len(child), 3), "child_offsets": offsets}
    return {**tables, "child": torch.tensor(child, dtype=torch.int32), "depth": depth}, leaves


def _make(draw: Draw, n: int) -> Arguments:
    tables, _ = tree(draw)
    return {"points": draw.points(n, draw.dtype()), **tables}


CASE = Case(
    _make,
    refused={"depth must be at most 2147483647, got 1099511627776": {"depth": 2**40}},
    device_rows=260,
    hostile="numbers",
)
