"""Draws valid arguments of ``routed_program`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from cases.locate_cell import tree
from voronerf.ops._core.program import Builder, Program
from voronerf.ops.nearest_centre import index_centres


def two_outputs(rays: bool) -> Program:
    """Returns a program of two layers and two outputs; the first layer reads positions and directions."""
    b = Builder()
    x, seen = b.input(3), b.input(3, ray=rays)
    hidden = b.linear(x, b.parameter(5, 3), 5, add=b.linear(seen, b.parameter(5, 3), 5))
    return b.program([b.apply("sigmoid", b.linear(hidden, b.parameter(4, 5), 4)), b.apply("tanh", hidden)])


def _make(draw: Draw, n: int) -> Arguments:
    by, rays = draw.among("by", "centres", "tree", "an index", "cells", "one cell"), draw.among("rays", False, True)
    where, k = tree(draw) if by == "tree" else ({}, 1 if by == "one cell" else draw.among("k", 2, 1, 9))
    if by in ("centres", "an index"):
        where = {"centres": draw.uniform(k, 3)}
    if by == "an index":
        where["centre_index"] = index_centres(where["centres"])
    if by == "cells":
        where = {"cells": draw.integers(0, k, n)}
    program, dtype, r = two_outputs(rays), draw.dtype(), draw.number("r", 4, 1, 9)
    parameters = [draw.normal(k, *shape, dtype=dtype) / 2 for shape in program.parameters]
    if draw.among("shared", False, True):
        parameters[-1] = parameters[-1][0]
    return {
        "program": program,
        "inputs": [draw.uniform(n, 3, dtype=dtype), draw.uniform(r if rays else n, 3, dtype=dtype)],
        "parameters": parameters,
        "ray_index": draw.integers(0, r, n) if rays else None,
        **where,
    }


CASE = Case(
    _make,
    {
        "": {},
        "nested, of rays": {"by": "tree", "rays": True},
        "by an index": {"by": "an index", "k": 40},
        "one cell": {"by": "one cell"},
        "of cells, with shared ones": {"by": "cells", "shared": True},
    },
    refused={
        "centre_index requires centres, got no centres": {"centres": None, "centre_index": torch.zeros(1).int()},
        "centres must have shape [k, 3] with k = 2, got [1, 3]": {"centres": torch.zeros(1, 3)},
        "parameters must have 3 tensors, got 0": {"parameters": []},
    },
    differentiable=True,
)
