"""Draws valid arguments of ``draw_points`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    box = draw.normal(2, 3) if draw.free else torch.tensor([[-1.0, 0, 2], [3.0, 0.5, 9]])
    return {"seed": draw.integers(-100, 100, 1), "count": n + 1, "box": box}


CASE = Case(_make, refused={"count must be at least 1, got 0": {"count": 0}}, traced=False, device_rows=260)
