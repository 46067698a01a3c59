from __future__ import annotations

import pytest
import torch
from op_cases import FLOATS, HALVES, need, refusals

from voronerf.ops import nearest_centre
from voronerf.ops._core.backends import BackendUnavailable

pytestmark = pytest.mark.op("nearest_centre")


def slow(points, centres):
    """One point and one centre at a time, in float64."""
    cells = []
    for point in points.double().tolist():
        distances = [sum((a - b) ** 2 for a, b in zip(point, centre)) for centre in centres.double().tolist()]
        cells.append(distances.index(min(distances)))
    return torch.tensor(cells, dtype=torch.int32)


@pytest.mark.parametrize("k", [1, 2, 17])
@pytest.mark.parametrize("n", [0, 1, 63, 130])
def test_matches_a_slow_loop_on_integers_ties_included(device, backend, n, k):
    points = torch.randint(-2, 3, (n, 3)).float()
    centres = torch.randint(-2, 3, (k, 3)).float()
    cells = nearest_centre(points.to(device), centres.to(device), backend=backend)
    assert cells.dtype == torch.int32
    assert cells.device.type == device.type
    assert torch.equal(cells.cpu(), slow(points, centres))


@pytest.mark.parametrize("shift", [0.0, 10.0, 1000.0])
@pytest.mark.parametrize("k", [16, 300])
def test_chosen_centre_is_nearest_in_float64_wherever_the_scene_is(device, backend, k, shift):
    points, centres = torch.rand(3001, 3) + shift, torch.rand(k, 3) + shift
    cells = nearest_centre(points.to(device), centres.to(device), backend=backend).cpu().long()
    distances = (points.double()[:, None] - centres.double()[None]).square().sum(-1)
    chosen = distances.gather(1, cells[:, None])[:, 0]
    # float32 may not tell apart two centres whose distances differ by less than its rounding.
    bound = 8 * 2.0**-24 * distances.min(dim=1).values
    assert (chosen <= distances.min(dim=1).values + bound).all()


def test_points_that_are_not_finite_go_to_cell_0(device, backend):
    nan, inf = float("nan"), float("inf")
    points = torch.tensor([[nan, 1, 1], [inf, 1, 1], [1, -inf, 1], [inf, -inf, nan], [1, 1, 1]], device=device)
    centres = torch.tensor([[9.0, 9, 9], [5, 5, 5], [1, 1, 1]], device=device)
    assert nearest_centre(points, centres, backend=backend).tolist() == [0, 0, 0, 0, 2]


@pytest.mark.parametrize("dtype", FLOATS)
def test_dtypes(device, backend, dtype):
    need("nearest_centre", backend, device, dtype)
    points, centres = torch.rand(257, 3).to(dtype), torch.rand(9, 3).to(dtype)
    cells = nearest_centre(points.to(device), centres.to(device), backend=backend)
    if dtype in HALVES:
        assert torch.equal(cells.cpu(), slow(points, centres))
    mixed = nearest_centre(points.to(device), centres.double().to(device), backend=backend)
    assert torch.equal(mixed.cpu(), slow(points, centres))


def test_is_not_differentiable(device, backend):
    points = torch.rand(5, 3, device=device, requires_grad=True)
    centres = torch.rand(2, 3, device=device, requires_grad=True)
    assert not nearest_centre(points, centres, backend=backend).requires_grad


def test_errors():
    points, centres = torch.rand(4, 3), torch.rand(2, 3)
    refuses = refusals(nearest_centre, points=points, centres=centres)
    refuses("centres must hold at least one centre, got none", centres=centres[:0])
    with pytest.raises((ValueError, BackendUnavailable), match="nearest_centre: backend"):
        nearest_centre(points, centres, backend="fastest")
