from __future__ import annotations

import pytest
import torch
from op_cases import refusals, strided

from voronerf.ops import select_heaviest

pytestmark = pytest.mark.op("select_heaviest")


@pytest.mark.parametrize(("n", "count"), [(0, 3), (1, 1), (5, 9), (1000, 37), (1000, 1000)])
def test_keeps_the_heaviest(device, backend, n, count):
    points = torch.rand(n, 3)
    importance = (torch.randperm(n) + 1).float() ** 5 * 1e-9
    found = select_heaviest(strided(points.to(device)), strided(importance.to(device)), count, backend=backend)
    order = importance.argsort(descending=True)[:count]
    assert torch.equal(found[0].cpu(), points[order]) and torch.equal(found[1].cpu(), importance[order])


def test_what_does_not_count_is_left_out(device, backend):
    points = torch.rand(8, 3)
    points[1, 2], points[2, 0] = torch.nan, torch.inf
    importance = torch.tensor([1.0, 9.0, 9.0, 0.0, torch.inf, torch.nan, -3.0, 2.0])
    found = select_heaviest(points.to(device), importance.to(device), 5, backend=backend)
    assert found[1].tolist() == [2, 1, 0, 0, 0]
    assert torch.equal(found[0].cpu(), torch.cat([points[[7, 0]], torch.zeros(3, 3)]))


def test_refuses_what_makes_no_sense():
    points = torch.rand(4, 3)
    refuses = refusals(select_heaviest, points=points, importance=torch.rand(4), count=2)
    refuses("importance must have dtype float32, got float64", importance=torch.rand(4).double())
    refuses("count must be at least 1, got 0", count=0)
