"""The case of ``sparse_adam``."""

from __future__ import annotations

from voronerf.ops.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    gradient = draw.normal(n, 2).contiguous() * (draw.uniform(n, 1) < 0.5)
    call: Arguments = {
        "parameter": draw.normal(n, 2).contiguous(),
        "gradient": gradient,
        "mean": draw.normal(n, 2).contiguous(),
    }
    return {
        **call,
        "square": draw.uniform(n, 2).contiguous(),
        "step": draw.number("step", 3, 1, 9),
        "learning_rate": 0.01,
    }


CASE = Case(_make, refused={"learning_rate must be a number, got str": {"learning_rate": "x"}}, in_place=True)
