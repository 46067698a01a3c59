"""Draws valid arguments of the ops on runs of samples for the tests, and lists invalid arguments.

The ops are ``own_samples``, ``run_sums``, ``compose_runs`` and ``run_gradients``.
"""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.ray_runs import compose_runs, own_samples, run_sums


def _make_known(draw: Draw, n: int) -> Arguments:
    """Draws n samples on three rays, in four cells, two of which are the rank's own."""
    cells = draw.integers(0, 4, n)
    call = {"positions": draw.uniform(n, 3), "ray_index": draw.integers(0, 3, n).sort()[0].int(), "cells": cells}
    depths = torch.linspace(1, 3, n) if n else torch.zeros(0)
    local_cells = torch.tensor([0, -1, 1, -1], dtype=torch.int32)
    call |= {"depths": depths, "deltas": draw.uniform(n), "local_cells": local_cells}
    if n > 100:  # short strata, so light reaches the end of a long ray
        call["deltas"] = 0.02 * call["deltas"]
    return {**call, "curved": draw.among("curved", False, True)}


def _make_outputs(draw: Draw, n: int) -> Arguments:
    samples = own_samples(**_make_known(draw, n), backend="reference")
    return {"raw": draw.normal(len(samples.cells), 4), "samples": samples, "density_scale": 2.0}


def _make_sums(draw: Draw, n: int) -> Arguments:
    sums, _ = run_sums(**_make_outputs(draw, n), backend="reference")
    background = draw.among("background", draw.uniform(3, 3), draw.uniform(3), None)
    return {
        "sums": sums,
        "target": draw.uniform(3, 3),
        "background": background,
        "first": 0,
        "rays": 3,
        "robust": draw.among("robust", 0.0, 0.05),
    }


def _make_answers(draw: Draw, n: int) -> Arguments:
    call = _make_outputs(draw, n)
    sums, _ = run_sums(**call, backend="reference")
    answers, _ = compose_runs(sums, draw.uniform(3, 3), first=0, rays=3, backend="reference")
    return {**call, "answers": answers, "hidden": draw.among("hidden", 0.0, 1e-3)}


CASES = {
    "own_samples": Case(_make_known, traced=False),
    "run_sums": Case(_make_outputs, refused={"samples must be OwnSamples, got int": {"samples": 3}}, traced=False),
    "compose_runs": Case(_make_sums, traced=False),
    "run_gradients": Case(_make_answers, refused={"hidden must lie in [0, 1), got 2.0": {"hidden": 2.0}}, traced=False),
}
