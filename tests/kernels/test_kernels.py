"""The Warp kernels against the reference, exactly."""

from __future__ import annotations

import pytest
import torch

from voronerf import backends
from voronerf.ops.nearest_centre.reference import nearest_centre as reference

pytestmark = pytest.mark.warp


@pytest.fixture
def nearest_centre(device):
    return backends.resolve("nearest_centre", backend="warp", device=device, dtype=torch.float32)


def agree(nearest_centre, points, centres, weights=None) -> None:
    cells = nearest_centre(points, centres, weights=weights)
    assert (cells.dtype, cells.device) == (torch.int32, points.device)
    assert torch.equal(cells, reference(points, centres, weights=weights))


@pytest.mark.parametrize("k", [1, 17, 257])
@pytest.mark.parametrize("n", [0, 1, 255, 257])
def test_nearest_centre(nearest_centre, device, n, k) -> None:
    for dtype in (torch.float32, torch.float64, torch.float16):
        for shift in (0, 1000):
            points = torch.rand(n, 3, device=device).to(dtype) + shift
            centres = torch.rand(k, 3, device=device) + shift
            agree(nearest_centre, points, centres)
            agree(nearest_centre, points, centres, torch.rand(k, device=device))


def test_nearest_centre_with_ties_strides_and_non_finite_points(nearest_centre, device) -> None:
    points = (torch.randint(-4, 5, (500, 6), device=device) / 2)[:, ::2]
    points[3], points[4, 1] = torch.nan, torch.inf
    centres = torch.randint(-2, 3, (3, 40), device=device).float().T
    assert not points.is_contiguous()
    agree(nearest_centre, points, centres)
    agree(nearest_centre, points, centres, torch.randint(0, 3, (80,), device=device).float()[::2])
