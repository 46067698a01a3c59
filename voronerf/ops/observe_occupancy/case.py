"""The case of ``observe_occupancy``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    density = draw.uniform(*(draw.number("side", side, 1, 9) for side in (2, 3, 4))).contiguous()
    call: Arguments = {"density": density, "occupied": density >= 0.4, "threshold": 0.4, "decay": 0.9, "hidden": 1e-3}
    call |= {name: draw.uniform(n) for name in ("sigma", "deltas", "weights")}
    space = draw.among("space", "world", "sphere", "perspective")
    if space != "world":
        call["contraction"] = draw.uniform(*((4,) if space == "sphere" else (5, 3))) + 0.1
    return {**call, "box": torch.tensor([[-1.0] * 3, [1.0] * 3]), "positions": draw.normal(n, 3)}


CASE = Case(
    _make, {"": {}, **{space: {"space": space} for space in ("sphere", "perspective")}}, in_place=True, device_rows=260
)
