"""Draws valid arguments of ``draw_pixels`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.draw_pixels.reference import KnownPixels, PixelRuns


def _make(draw: Draw, n: int) -> Arguments:
    runs = PixelRuns.of(torch.tensor([3, 20, 90]), torch.tensor([5, 1, 40]))
    some = draw.among("runs", runs, None)
    below = draw.number("below", 50, 1, 1000) if some is None else runs.total
    call = {"seed": draw.integers(-100, 100, 1), "count": n + 1, "below": below, "runs": some}
    known = KnownPixels(draw.integers(0, 90, 5).long(), draw.uniform(5), draw.number("draws", n // 3, 0, n + 1))
    return {**call, "known_pixels": known if draw.among("known", False, True) else None}


CASE = Case(
    _make,
    {"": {}, "known": {"known": True}},
    refused={"below must be at least 1, got 0": {"below": 0, "runs": None}},
    traced=False,
    device_rows=260,
    hostile="indices",
)
