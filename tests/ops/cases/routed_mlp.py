"""Draws valid arguments of ``routed_mlp`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from cases.grouped_mlp import GAUSSIANS, network
from cases.locate_cell import tree
from voronerf.ops.nearest_centre import index_centres


def _make(draw: Draw, n: int) -> Arguments:
    by = draw.among("by", "centres", "tree", "an index", "cells", "one cell")
    if by == "tree":
        tables, k = tree(draw)
        return {**network(draw, n, k), **tables}
    k = 1 if by == "one cell" else draw.among("k", 2, 1, 9)
    centres = draw.uniform(k, 3)
    where: Arguments = {"cells": draw.integers(0, k, n)} if by == "cells" else {"centres": centres}
    if by == "an index":
        where["centre_index"] = index_centres(centres)
    return {**network(draw, n, k), **({} if by == "one cell" else where)}


CASE = Case(
    _make,
    {
        "": {},
        "nested": {"by": "tree"},
        "by an index": {"by": "an index", "k": 40},
        "one cell": {"by": "one cell", **GAUSSIANS},
        "of cells": {"by": "cells"},
    },
    refused={"centres must have shape [k, 3] with k = 2, got [1, 3]": {"centres": torch.zeros(1, 3)}},
    differentiable=True,
)
