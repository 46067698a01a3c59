"""The case of ``first_solid``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw
from voronerf.ops.first_solid.reference import KINDS, Solids


def _make(draw: Draw, n: int) -> Arguments:
    """n rays from around 20 solids, or from one point, or parallel, to about the middle."""
    m = draw.number("solids", 20, 0, 70)
    measures = 0.1 + 0.3 * draw.uniform(m, 3)
    measures[:, 2] = measures[:, 0] + measures[:, 1]
    turns = torch.linalg.qr(draw.normal(m, 3, 3).double())[0].float()
    solids = Solids(draw.integers(0, len(KINDS), m), 2 * draw.uniform(m, 3) - 1, turns, measures)
    rays, aims = draw.among("rays", "any", "from a point", "parallel"), 2 * draw.uniform(n, 3) - 1
    if rays == "parallel":
        directions = draw.unit(1)
        origins = aims - 5 * directions
    else:
        origins = 5 * draw.unit(1 if rays == "from a point" else n)
        directions = torch.nn.functional.normalize(aims - origins)
    return {"origins": origins, "directions": directions, "solids": solids}


CASE = Case(
    _make,
    kinds={"any": {}, "from a point": {"rays": "from a point"}, "parallel": {"rays": "parallel"}},
    refused={
        "solids must be Solids, got int": {"solids": 3},
        "directions must be as many as the 3 origins, or one, got 2": {
            "origins": torch.zeros(3, 3),
            "directions": torch.zeros(2, 3),
        },
    },
    traced=False,
)
