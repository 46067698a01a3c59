"""The case of ``cast_solids``."""

from __future__ import annotations

import torch

from voronerf.ops.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    s = draw.number("solids", 4, 0, 9)
    frames = torch.cat([torch.eye(3).expand(s, 3, 3), draw.normal(s, 1, 3) / 2], dim=1)
    kinds = draw.integers(0, 4, s) if draw.free else torch.arange(4, dtype=torch.int32)
    origins = 4 * draw.unit(n)
    solids = {"kinds": kinds, "frames": frames, "sizes": 0.2 + 0.2 * draw.uniform(s, 3)}
    return {**solids, "origins": origins, "directions": -origins / 4}


CASE = Case(
    _make,
    refused={"kinds must be 0 (sphere) to 3 (torus), got -5": {"kinds": torch.full((4,), -5, dtype=torch.int32)}},
    compiles=False,
)
