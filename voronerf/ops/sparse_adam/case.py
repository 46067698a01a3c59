"""The cases of ``sparse_adam`` and ``adam``."""

from __future__ import annotations

import torch

from voronerf.ops.cases import Arguments, Case, Draw
from voronerf.ops.sparse_adam import Guard, Rule


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


def _make_lists(draw: Draw, n: int) -> Arguments:
    one, other = _make(draw, n), _make(draw, 3)
    lists = {f"{name}s": [one[name], other[name]] for name in ("parameter", "gradient", "mean", "square")}
    steps = torch.tensor(2.0), torch.tensor(0.0)
    guard = draw.among("guard", Guard.on("cpu"), None)
    loss = None if guard is None else torch.tensor(draw.among("loss", 0.5, torch.nan))
    return {"rules": [Rule(steps[0], 0.01), Rule(steps[1], 0.02, every=False)], **lists, "guard": guard, "loss": loss}


CASE = Case(_make, refused={"learning_rate must be a number, got str": {"learning_rate": "x"}}, in_place=True)
CASES = {"sparse_adam": CASE, "adam": Case(_make_lists, in_place=True)}
