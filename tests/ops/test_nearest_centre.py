from __future__ import annotations

import time

import pytest
import torch
from helpers import all_pairs
from op_cases import FLOATS, compared, need, refusals

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
    points = torch.rand(257, 3).to(dtype)
    for other in FLOATS:
        centres = torch.rand(9, 3).to(other)
        cells = nearest_centre(points.to(device), centres.to(device), backend=backend)
        assert torch.equal(cells.cpu(), slow(points, centres))


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


KINDS = ["normal", "lattice", "heavy-tailed", "one place", "in turns"]


@compared("nearest_centre")
@pytest.mark.parametrize(*all_pairs({"kind": KINDS, "d": [3, 2, 1, 4], "dtype": [torch.float32, torch.float64]}))
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


def leaf_beside(corner, sign=1.0):
    """Returns 16 centres: ``corner``, and 15 beyond it in every coordinate, in the direction of ``sign``."""
    return corner + sign * torch.rand(16, *corner.shape) * (torch.arange(16) > 0)[:, None]


@pytest.mark.parametrize("d", [2, 3, 4])
def test_an_index_searches_every_box_within_rounding_of_the_bound(device, backend, d):
    """The distances of a box and of the centre at its corner are equal, so that rounding alone decides on the box.

    Before each point, a point at a centre is searched; the distance of this centre bounds the next search.
    """
    first, wide = 0.5 + torch.rand(d) / 2, 6.0 * torch.randint(0, 2, (16, d)) - 3
    wide[:, 0] = torch.linspace(-8, 0.9, 16)  # this box contains all points, but its centres are farther
    second, places = -first.roll(1), torch.rand(4000, d)
    apart = first.double() - second
    between = 0.8 * places.double() - 0.4
    between -= ((between - (first + second) / 2) @ apart / apart.square().sum())[:, None] * apart
    for centres, points, before in (
        (torch.cat([leaf_beside(first), leaf_beside(second, -1)]), between.float(), second),  # nearly equidistant
        (torch.cat([leaf_beside(torch.ones(d)), wide]), 0.9 * places, torch.ones(d)),
    ):
        points = torch.stack([before.expand_as(points), points], 1).flatten(0, 1)
        expected = nearest_centre(points, centres, backend="reference")
        arguments = points.to(device), centres.to(device)
        actual = nearest_centre(*arguments, index=index_centres(arguments[1]), backend=backend)
        assert torch.equal(actual.cpu(), expected)


@pytest.mark.parametrize(
    ("point", "near", "far"),
    [
        (
            [0.9919149279594421, 0.8160637021064758],
            [-0.018330218270421028, 0.7778263688087463],
            [1.0301523208618164, 1.8263088464736938],
        ),
        (
            [0.11957439035177231, 0.7280321717262268, 0.9673336148262024],
            [-0.02519385889172554, 0.5628674030303955, -0.037263162434101105],
            [0.2847391664981842, 1.7326289415359497, 1.1121019124984741],
        ),
        (
            [0.9755188822746277, 0.7881345152854919, 0.02936580590903759, 0.9104934334754944],
            [1.0191012620925903, 0.828106701374054, 0.5343273282051086, 0.9598747491836548],
            [0.4705573618412018, 0.7387531995773315, -0.014216607436537743, 0.8705212473869324],
        ),
    ],
    ids=["2", "3", "4"],
)
def test_the_largest_rounding_of_float32_is_within_the_margin(device, backend, point, near, far):
    """In float32, the nearer centre seems farther by 3.4e-7 of the distance, the worst of ten million random cases."""
    for nearest, centres in enumerate(([near, far], [far, near])):
        arguments = torch.tensor([point], device=device), torch.tensor(centres, device=device)
        for index in (None, index_centres(arguments[1])):
            assert nearest_centre(*arguments, index=index, backend=backend).tolist() == [nearest]


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
        own = index_centres(centres)
        refuses("index must belong to these centres, float32 [2, 3], got int32 [79]", index=own[:-1])
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
        with pytest.raises(kind, match=f"^{message}"):
            index_centres(arguments)
    with pytest.raises((ValueError, BackendUnavailable), match="nearest_centre: backend"):
        nearest_centre(points, centres, backend="fastest")
