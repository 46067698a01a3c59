"""Draws valid arguments of ``adam`` and ``average`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.adam import Guard, UpdateRule


def _make(draw: Draw, n: int) -> Arguments:
    lists: Arguments = {"parameters": [], "gradients": [], "means": [], "squares": []}
    for size in (n, 3):
        for name in ("parameters", "means"):
            lists[name].append(draw.normal(size, 2).contiguous())
        lists["gradients"].append(draw.normal(size, 2).contiguous() * (draw.uniform(size, 1) < 0.5))
        lists["squares"].append(draw.uniform(size, 2).contiguous())
    guard = draw.among("guard", Guard.on("cpu"), None)
    loss = None if guard is None else torch.tensor(draw.among("loss", 0.5, torch.nan))
    rules = [UpdateRule(torch.tensor(2.0), 0.01), UpdateRule(torch.tensor(0.0), 0.02, dense=False)]
    return {"rules": rules, **lists, "guard": guard, "loss": loss}


def _make_averages(draw: Draw, n: int) -> Arguments:
    averages, parameters = ([draw.normal(size, 2).contiguous() for size in (n, 3)] for _ in range(2))
    return {"averages": averages, "parameters": draw.among("parameters", parameters, None), "share": 0.25}


CASES = {
    "adam": Case(_make, refused={"loss must come with a guard, got none": {"guard": None}}, in_place=True),
    "average": Case(_make_averages, refused={"share must lie in 0 to 1, got 2.0": {"share": 2.0}}, in_place=True),
}
