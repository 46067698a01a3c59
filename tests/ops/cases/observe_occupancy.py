"""Draws valid arguments of ``observe_occupancy`` for the tests."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    density = draw.uniform(*(draw.number("side", side, 1, 9) for side in (2, 3, 4))).contiguous()
    call: Arguments = {"density": density, "occupied": density >= 0.4, "threshold": 0.4, "decay": 0.9, "hidden": 1e-3}
    call["sigma"] = draw.uniform(n)
    space = draw.among("space", "world", "sphere", "perspective")
    if space != "world":
        call["contraction"] = draw.uniform(*((4,) if space == "sphere" else (5, 3))) + 0.1
    if draw.among("rays", True, False):
        call |= {name: draw.uniform(n) for name in ("deltas", "weights")}
    if draw.among("fixed", False, True):
        call["fixed"] = draw.uniform(*density.shape) < 0.4
    return {**call, "box": torch.tensor([[-1.0] * 3, [1.0] * 3]), "positions": draw.normal(n, 3)}


CASE = Case(
    _make,
    {
        "": {},
        "points alone": {"rays": False, "fixed": True},
        **{space: {"space": space} for space in ("sphere", "perspective")},
    },
    in_place=True,
    device_rows=260,
)
