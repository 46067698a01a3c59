"""The case of ``unseen_rays``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    rays = {"origins": draw.normal(n, 3).contiguous(), "directions": draw.unit(n).contiguous()}
    pairs = draw.number("pairs", n // 4, 0, n // 2)
    return {**rays, "seed": draw.integers(-100, 100, 1), "pairs": pairs, "move": 0.25, "tilt": 0.01}


CASE = Case(
    _make,
    refused={
        "pairs must be at most half of the 6 rays, got 4": {"pairs": 4},
        "move must be positive, got 0.0": {"move": 0.0},
        "origins must be contiguous, got strides (1, 6)": {"origins": torch.zeros(3, 6).T},
    },
    in_place=True,
    traced=False,
)
