"""Draws valid arguments of ``hash_encode`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops._core.grids import HashGrid


def hash_grid(draw: Draw) -> HashGrid:
    """Draws a grid whose coarse levels are dense and whose fine levels are hashed."""
    base = draw.number("base", 3, 2, 9)
    return HashGrid(
        levels=draw.number("levels", 3, 1, 5),
        features=draw.among("features", 2, 1, 4),
        log2_entries=draw.number("log2_entries", 10, 10, 12),
        base=base,
        finest=base + draw.number("finest", 37, 1, 50),
    )


def _make(draw: Draw, n: int) -> Arguments:
    grid, k = hash_grid(draw), draw.among("k", None, 1, 3)
    table = draw.normal(*grid.table_shape if k is None else (k, *grid.table_shape), dtype=draw.dtype())
    positions = 3 * draw.uniform(n, 3, dtype=draw.dtype(*(torch.float32, torch.float64))) - 1
    return {
        "positions": positions,
        "table": table,
        "grid": grid,
        "cells": None if k is None else draw.integers(0, k, n),
    }


CASE = Case(
    _make,
    {"": {}, "of cells": {"k": 2}},
    refused={"grid must be a HashGrid, got dict": {"grid": {}}},
    differentiable=True,
    on_devices=[{"features": features} for features in (1, 4, 8)],
    hostile="indices",
)
