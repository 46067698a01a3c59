"""Random points in a box."""

from __future__ import annotations

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need

from voronerf.ops import draw_points

pytestmark = pytest.mark.op("draw_points")
BOX = torch.tensor([[-1.0, 10.0, 0.0], [1.0, 10.5, 300.0]])


def test_points_are_everywhere_and_axes_independent(device, backend):
    need("draw_points", backend, device, torch.int32)
    seed = torch.tensor([-7], dtype=torch.int32)
    points = draw_points(seed.to(device), 40_000, BOX.to(device), backend=backend).cpu()
    assert torch.equal(points, draw_points(seed, 40_000, BOX, backend="reference"))
    place = ((points - BOX[0]) / (BOX[1] - BOX[0]) * 4).clamp(0, 3).long()
    counts = torch.bincount((place[:, 0] * 4 + place[:, 1]) * 4 + place[:, 2], minlength=64)
    assert bool(((counts - 625).abs() < 150).all())  # six standard deviations


def test_seeds_and_threads():
    need("draw_points", "native", torch.device("cpu"), torch.int32)
    seeds = [torch.tensor([seed], dtype=torch.int32) for seed in (3, 4, 3)]
    one, two, three = (draw_points(seed, 5000, BOX, backend="native") for seed in seeds)
    assert torch.equal(one, three) and not torch.equal(one, two)
    on_any_number_of_threads(lambda: draw_points(seeds[0], 5000, BOX, backend="native"))
