"""Draws valid arguments of ``render_opaque`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops.formulas import SPACINGS
from voronerf.ops.nearest_centre import index_centres
from voronerf.ops.network import Cells, Network

_GRID = HashGrid(levels=2, features=2, log2_entries=10, finest=20)


def _make(draw: Draw, n: int) -> Arguments:
    k, sides = draw.number("cells", 3, 1, 9), [draw.number("side", side, 1, 9) for side in (5, 4, 6)]
    hashed = draw.among("positions", "hashed", "as they are") == "hashed"
    encoding: Arguments = {"position_encoding": "hash", "grid": _GRID} if hashed else {}
    density = draw.among("density", "softplus", "relu")
    ends = Layer((0, DIRECTIONS), 3, "sigmoid"), Layer((0,), 1, density)
    table = MLP((Layer((POSITIONS,), 6, "relu"), *ends), (1, 2), **encoding)
    cells = Cells(centres=draw.uniform(k, 3) - 0.5)
    if draw.among("indexed", False, True):
        cells = cells._replace(centre_index=index_centres(cells.centres))
    weights = [draw.normal(k, o, i) for o, i in table.weight_shapes(3, 3)]
    parameters = [*weights, draw.normal(k, 6), 4 + draw.normal(k, 1)]
    if hashed:
        parameters.append(draw.normal(*_GRID.table_shape))
    network = Network(table.program(3, 3, None, (True, False, True), True), parameters)
    directions = draw.unit(n)
    origins = 2 * draw.normal(n, 3) if draw.free else -directions
    call: Arguments = {"origins": origins, "directions": directions, "network": network, "cells": cells}
    call |= {"near": 0.01 + draw.uniform(n), "far": 3 + draw.uniform(n), "samples": draw.among("samples", 40, 1, 130)}
    call |= {"occupied": draw.uniform(*sides) < 0.6, "box": torch.tensor([[-1.0] * 3, [1.0] * 3])}
    call |= {"wave": draw.number("wave", 5, 1, 9), "opaque": draw.among("opaque", 0.02, 0.0, 0.5)}
    call["spacing"] = draw.among("spacing", *SPACINGS)
    sphere = draw.uniform(4) + 0.1
    call["contraction"] = draw.among("contraction", None, sphere, draw.uniform(5, 3) + 0.1)
    call["background"] = draw.among("background", None, draw.uniform(3), draw.uniform(n, 3))
    return {**call, "heaviest": draw.among("heaviest", True, False)}


CASE = Case(
    _make,
    {"": {}, "relu": {"density": "relu"}, "by an index": {"indexed": True, "cells": 40}},
    refused={
        "network must be a Network, got int": {"network": 3},
        "cells must be Cells, got int": {"cells": 3},
        "cells must hold a diagram alone, got offsets": {"cells": Cells(torch.zeros(2, dtype=torch.int32))},
        "wave must be at least 1, got 0": {"wave": 0},
        "opaque must lie in [0, 1), got 1.0": {"opaque": 1.0},
    },
    traced=False,
)
