"""Draws valid arguments of ``unseen_rays`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    rays = {"origins": draw.normal(n, 3).contiguous(), "directions": draw.unit(n).contiguous()}
    triples = draw.number("triples", n // 4, 0, n // 3)
    return {**rays, "seed": draw.integers(-100, 100, 1), "triples": triples, "move": 0.25, "tilt": 0.1}


CASE = Case(
    _make,
    refused={
        "triples must be at most a third of the 6 rays, got 3": {"triples": 3},
        "move must be positive, got 0.0": {"move": 0.0},
        "origins must be contiguous, got strides (1, 6)": {"origins": torch.zeros(3, 6).T},
    },
    in_place=True,
    traced=False,
)
