"""The cases of ``observe_occupancy``, ``observe_told`` and ``tell_observed``."""

from __future__ import annotations

import torch

from voronerf.ops.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    density = draw.uniform(*(draw.number("side", side, 1, 9) for side in (2, 3, 4))).contiguous()
    call: Arguments = {"density": density, "occupied": density >= 0.4, "threshold": 0.4, "decay": 0.9, "hidden": 1e-3}
    call |= {name: draw.uniform(n) for name in ("sigma", "deltas", "weights")}
    return {**call, "box": torch.tensor([[-1.0] * 3, [1.0] * 3]), "positions": draw.normal(n, 3)}


def _make_told(draw: Draw, n: int) -> Arguments:
    call = _make(draw, n)
    cells = draw.integers(0, call["density"].numel(), 5).contiguous()
    return {
        "grid": tuple(call[name] for name in ("density", "occupied", "box")),
        "samples": tuple(call[name] for name in ("positions", "sigma", "deltas", "weights")),
        "told": torch.stack((cells.view(torch.float32), draw.uniform(5)), 1),
        "reached": draw.among("reached", None, call["density"].reshape(-1) > 0.3),
        **{name: call[name] for name in ("threshold", "decay", "hidden")},
    }


def _make_teller(draw: Draw, n: int) -> Arguments:
    call = _make_told(draw, n)
    return {name: call[name] for name in ("grid", "samples", "hidden")} | {"several": call["reached"]}


CASE = Case(_make, in_place=True)
CASES = {
    "observe_occupancy": CASE,
    "observe_told": Case(_make_told, in_place=True),
    "tell_observed": Case(_make_teller, in_place=True),
}
