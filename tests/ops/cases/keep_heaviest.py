"""Draws valid arguments of ``keep_heaviest`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    b, q, d, r = (
        draw.number(*range_of) for range_of in (("b", 3, 1, 4), ("q", 5, 1, 40), ("d", 3, 1, 4), ("r", 4, 1, 9))
    )
    kept: Arguments = {"kept_points": draw.uniform(b, q, d).contiguous(), "added": draw.integers(0, 100, 1).long()}
    kept["kept_importance"] = draw.uniform(b, q).contiguous()
    # Integer weights take few values, so some are equal.
    weights = draw.integers(-1, 20, n) / 16 if draw.among("equal", False, True) else draw.uniform(n)
    rays = {"error": draw.uniform(r), "ray_index": draw.integers(0, r, n)}
    return {
        **kept,
        "points": draw.normal(n, d),
        "weights": weights,
        **(rays if draw.among("rays", True, False) else {}),
    }


CASE = Case(
    _make,
    {"": {}, "weights alone": {"rays": False, "equal": True}},
    refused={
        "error and ray_index must be given together, got no error": {"error": None},
        "kept_importance must have at least one place, got [0, 5]": {
            "kept_points": torch.zeros(0, 5, 3),
            "kept_importance": torch.zeros(0, 5),
        },
    },
    in_place=True,
    traced=False,
)
