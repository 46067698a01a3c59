from __future__ import annotations

import time

import pytest
import torch
from op_cases import FLOATS, HALVES, need, refusals

from voronerf.ops import index_centres, nearest_centre
from voronerf.ops._core.backends import BackendUnavailable

pytestmark = pytest.mark.op("nearest_centre")


def slow(points, centres):
    """Compares each point with each centre in a float64 loop."""
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
    # In float32, two centres whose distances differ by less than the rounding may be confused.
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


def some_centres(kind, k, d, dtype):
    """Returns k centres by ``kind``: normal, on a lattice with duplicates, heavy-tailed, all at one place, or along a
    line that is traversed four times ("in turns")."""
    centres = torch.randn(k, d, dtype=torch.float64)
    if kind == "in turns":
        centres = torch.linspace(0, 1, k // 4 + 1, dtype=torch.float64).repeat(4)[:k, None].expand(k, d)
    if kind == "lattice":
        centres = torch.randint(-4, 5, (k, d)).double()
    if kind == "heavy-tailed":
        centres = centres * torch.rand(k, 1, dtype=torch.float64).pow(-2)
    return (centres * (kind != "one place")).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("d", [1, 2, 3, 4])
@pytest.mark.parametrize("kind", ["normal", "lattice", "heavy-tailed", "one place", "in turns"])
def test_an_index_finds_the_same_centres(device, backend, kind, d, dtype):
    for k in (1, 16, 17, 33, 300, 4097):
        centres = some_centres(kind, k, d, dtype)
        n = 15 if kind == "one place" else 150  # at one place, each point is compared with all centres
        points = torch.cat([some_centres(kind, n, d, dtype), torch.randint(-9, 10, (n, d)).to(dtype) / 2, centres[:9]])
        points[7], points[10, 0], points[11, 0], points[12] = 1e30, torch.nan, -torch.inf, 1e-42
        expected = nearest_centre(points, centres, backend="reference")
        for index in (None, index_centres(centres.to(device))):
            arguments = points.to(device), centres.to(device)
            assert torch.equal(nearest_centre(*arguments, index=index, backend=backend).cpu(), expected), (
                k,
                index is None,
            )


def test_many_centres_and_points_without_an_index(device, backend):
    """On the CPU the call builds its own index."""
    points, centres = torch.rand(1500, 3), torch.rand(3000, 3)
    result = nearest_centre(points.to(device), centres.to(device), backend=backend)
    assert torch.equal(result.cpu(), nearest_centre(points, centres, backend="reference"))


def test_centres_in_turns_take_as_long_as_others():
    """Building the index must not sample centres at a fixed stride, which sees the same part of each repetition."""
    seconds = []
    for centres in (torch.rand(200_000, 1), torch.linspace(0, 1, 20_000).repeat(10)[:, None]):
        begin = time.process_time()
        index_centres(centres)
        seconds.append(time.process_time() - begin)
    assert seconds[1] < 5 * seconds[0] + 0.1


def test_an_index_of_centres_that_are_no_numbers_harms_nothing():
    centres = torch.rand(500, 3)
    centres[::3] = torch.nan
    centres[1::9, 1] = torch.inf
    result = nearest_centre(torch.rand(99, 3), centres, index=index_centres(centres))
    assert centres[result.long()].isfinite().all()


def test_errors():
    points, centres = torch.rand(4, 3), torch.rand(2, 3)
    refuses = refusals(nearest_centre, points=points, centres=centres)
    refuses("centres must hold at least one centre, got none", centres=centres[:0])
    many = {"points": torch.rand(4, 5), "centres": torch.rand(2, 5)}
    for backend in ("reference", "auto"):
        refuses("centres must have shape [k, d], d = 1 to 4, got [2, 5]", **many, backend=backend)
    if (other := index_centres(torch.rand(20, 3))) is not None:
        refuses("index must belong to these centres, float32 [2, 3], got int32 [240]", index=other)
        refuses("index must belong to these centres, float32 [2, 3], got int32 [0]", index=other[:0])
        many = {"points": points, "centres": torch.rand(25, 3)}
        rule = "index must belong to these centres, float32 [25, 3]"
        refuses(f"{rule}, got an index of float32 [20, 3]", index=other, **many)
        double = {"points": points.double(), "centres": centres.double()}
        refuses("index must belong to these centres, float64 [2, 3], got int32 [64]", index=other[:64], **double)
    for kind, arguments, message in (
        (ValueError, torch.rand(0, 3), "index_centres: centres must hold at least one centre, got none"),
        (ValueError, torch.rand(3), "index_centres: centres must have shape"),
        (ValueError, torch.rand(3, 5), "index_centres: centres must have shape"),
        (TypeError, torch.ones(3, 3, dtype=torch.int64), "index_centres: centres must have dtype"),
        (TypeError, [1.0], "index_centres: centres must be a tensor, got list"),
    ):
        with pytest.raises(kind) as caught:
            index_centres(arguments)
        assert str(caught.value).startswith(message)
    with pytest.raises((ValueError, BackendUnavailable), match="nearest_centre: backend"):
        nearest_centre(points, centres, backend="fastest")
