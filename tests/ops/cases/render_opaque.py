"""Draws valid arguments of ``render_opaque`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops.formulas import SPACINGS
from voronerf.ops.nearest_centre import index_centres

_GRID = HashGrid(levels=2, features=2, log2_entries=10, finest=20)


def _make(draw: Draw, n: int) -> Arguments:
    k, sides = draw.number("cells", 3, 1, 9), [draw.number("side", side, 1, 9) for side in (5, 4, 6)]
    hashed = draw.among("positions", "hashed", "as they are") == "hashed"
    encoding: Arguments = {"position_encoding": "hash", "grid": _GRID} if hashed else {}
    activated = draw.among("activated", False, True)
    colour, density = ("sigmoid", "relu") if activated else ("none", "none")
    ends = Layer((0, DIRECTIONS), 3, colour), Layer((0,), 1, density)
    table = MLP((Layer((POSITIONS,), 6, "relu"), *ends), (1, 2), **encoding)
    network: Arguments = {"program": table.program(3, 3, None, (True, False, True), True)}
    network["centres"] = draw.uniform(k, 3) - 0.5
    if draw.among("indexed", False, True):
        network["centre_index"] = index_centres(network["centres"])
    weights = [draw.normal(k, o, i) for o, i in table.weight_shapes(3, 3)]
    network["parameters"] = [*weights, draw.normal(k, 6), (4 if activated else 1) + draw.normal(k, 1)]
    if hashed:
        network["parameters"].append(draw.normal(*_GRID.table_shape))
    directions = draw.unit(n)
    origins = 2 * draw.normal(n, 3) if draw.free else -directions
    call: Arguments = {"origins": origins, "directions": directions, "network": network}
    call |= {"near": 0.01 + draw.uniform(n), "far": 3 + draw.uniform(n), "samples": draw.among("samples", 40, 1, 130)}
    call |= {"occupied": draw.uniform(*sides) < 0.6, "box": torch.tensor([[-1.0] * 3, [1.0] * 3])}
    call |= {"activated": True} if activated else {"density_scale": 5.0}
    call |= {"wave": draw.number("wave", 5, 1, 9), "opaque": draw.among("opaque", 0.02, 0.0, 0.5)}
    call["spacing"] = draw.among("spacing", *SPACINGS)
    sphere = draw.uniform(4) + 0.1
    call["contraction"] = draw.among("contraction", None, sphere, draw.uniform(5, 3) + 0.1)
    call["background"] = draw.among("background", None, draw.uniform(3), draw.uniform(n, 3))
    return {**call, "heaviest": draw.among("heaviest", True, False)}


CASE = Case(
    _make,
    {"": {}, "activated": {"activated": True}, "by an index": {"indexed": True, "cells": 40}},
    refused={
        "network must hold program and parameters, got 3": {"network": 3},
        "network must hold program and parameters, got program": {"network": {"program": None}},
        "wave must be at least 1, got 0": {"wave": 0},
        "opaque must lie in [0, 1), got 1.0": {"opaque": 1.0},
        "density_scale must be positive, got 0": {"density_scale": 0},
        "density_scale must be given unless the values are activated, got None": {"density_scale": None},
        "density_scale must not be given for activated values, got 5.0": {"activated": True},
    },
    traced=False,
)
