"""The Warp kernels as PyTorch ops: what the tests of every backend (tests/ops) leave open."""

from __future__ import annotations

import pytest
import torch

pytestmark = pytest.mark.warp


def test_locate_cell_stays_inside_unsound_tables() -> None:
    pytest.importorskip("voronerf.kernels.locate_cell")
    points, centres = torch.rand(7, 3), torch.rand(3, 3)
    for offsets, child, depth in (
        ([0, 3], [5, 1_000_000_000, 9], 3),  # no such diagram
        ([0, 2_000_000_000], [-1, -2, -3], 1),  # more centres than there are
        ([0, 0, 3], [1, 1, 1], 2),  # a diagram without centres
        ([0, 1, 3], [1, 1, 0], 4),  # a walk that ends at no leaf
    ):
        tables = (torch.tensor(table, dtype=torch.int32) for table in (offsets, child))
        leaves = torch.ops.voronerf.locate_cell_warp(points, centres, *tables, depth)
        assert bool((leaves < 3).all())
        assert bool((leaves < 0).all()) == (offsets != [0, 2_000_000_000])
