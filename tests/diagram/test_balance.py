"""Balanced and centroidal centres: the published update, the paper's figure of merit, and a plain loop."""

import math
import statistics

import pytest
import torch
from helpers import refuses, seeded

from voronerf import ops
from voronerf.diagram import VoronoiDiagram, split_diagram
from voronerf.diagram.balance import balance, cell_weights, first_centres, imbalance, lloyd
from voronerf.ops.balance_centres.reference import published_step


def surface_samples(seed, m=10_000, objects=1, tail=1.0):
    """Returns samples near the surfaces of separate balls, with log-normal importance that is larger on one side."""
    generator = seeded(seed)
    across = math.ceil(objects ** (1 / 3))
    grid = torch.cartesian_prod(*[torch.arange(float(across)) * 2] * 3)
    places = grid[torch.randperm(across**3, generator=generator)[:objects]]
    radii = torch.rand(objects, generator=generator) * 0.5 + 0.2
    member = torch.multinomial(torch.rand(objects, generator=generator) + 0.2, m, replacement=True, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(m, 3, generator=generator), dim=1)
    distance = radii[member, None] * (1 + 0.02 * torch.randn(m, 1, generator=generator))
    importance = (tail * torch.randn(m, generator=generator)).exp() * (1 + 3 * normals[:, 0].clamp(min=0))
    return places[member] + normals * distance, importance


def test_one_step_is_the_published_update():
    """One step equals the published update, which tests/ops compares with slow loops."""
    points, importance = surface_samples(1, m=500)
    start, result = (balance(points, importance, 9, steps=steps, generator=seeded(7)) for steps in (0, 1))
    expected = published_step(start.centres, start.after, alpha=0.05, neighbours=8)
    torch.testing.assert_close(result.centres, expected)
    assert torch.equal(result.before, start.after) and not torch.equal(result.centres, start.centres)


def test_weights_are_those_of_the_returned_centres():
    points, importance = surface_samples(2, m=1000)
    result = balance(points, importance, 7, generator=seeded(0))
    nearest = torch.cdist(points.double(), result.centres.double()).argmin(1)
    expected = [float(importance.double()[nearest == i].sum()) for i in range(7)]
    assert torch.allclose(result.after, torch.tensor(expected, dtype=torch.float64))
    assert result.imbalance_after == pytest.approx(statistics.pstdev([w / max(expected) for w in expected]))
    assert float(result.after.sum()) == pytest.approx(float(importance.double().sum()))
    cells = VoronoiDiagram(result.centres).locate(points)
    assert torch.allclose(cell_weights(cells, importance, 7), result.after)


def test_published_update_reaches_the_papers_balance_on_one_object():
    results = [balance(*surface_samples(seed, tail=0.5), 16, generator=seeded(seed)) for seed in range(5)]
    assert 0.2 < statistics.median(result.imbalance_before for result in results) < 0.35
    assert statistics.median(result.imbalance_after for result in results) < 0.01


@pytest.mark.parametrize("centres", ["balanced", "centroidal"])
def test_same_generator_same_centres(centres):
    points, importance = surface_samples(5, m=2000)
    first, second, other = (
        balance(points, importance, 12, centres=centres, steps=50, generator=seeded(seed)) for seed in (3, 3, 4)
    )
    assert torch.equal(first.centres, second.centres)
    assert not torch.equal(first.centres, other.centres)
    # The global generator is used only if the call passes no generator.
    torch.manual_seed(3)
    assert torch.equal(balance(points, importance, 12, centres=centres, steps=50).centres, first.centres)
    state = torch.get_rng_state()
    balance(points, importance, 12, centres=centres, steps=5, generator=seeded(0))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("centres", ["balanced", "centroidal"])
def test_one_cell_and_as_many_cells_as_samples(centres):
    points, importance = surface_samples(6, m=20, tail=0.0)
    single = balance(points, importance, 1, centres=centres)
    assert (single.imbalance_before, single.imbalance_after) == (0.0, 0.0)
    assert single.after.tolist() == pytest.approx([float(importance.sum())])
    every = balance(points, torch.ones(20), 20, centres=centres, steps=20)
    assert every.centres.shape == (20, 3)
    assert bool(torch.isfinite(every.centres).all())
    assert balance(points[:1], importance[:1], 1, centres=centres).imbalance_after == 0.0


@pytest.mark.parametrize("centres", ["balanced", "centroidal"])
def test_samples_at_one_place(centres):
    same = torch.ones(50, 3)
    assert balance(same, torch.ones(50), 1, centres=centres).imbalance_after == 0.0
    refuses("number of distinct points, 1, got 2", balance, same, torch.ones(50), 2, centres=centres)
    two = torch.cat([same, -same])
    result = balance(two, torch.ones(100), 2, centres=centres)
    assert result.after.tolist() == [50.0, 50.0]


def test_first_centres_are_distinct_samples_and_follow_the_importance():
    points = torch.tensor([[0.0, 0, 0]] * 97 + [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    for kind in ("random", "centroidal"):
        centres = first_centres(points, torch.ones(100).double(), 4, kind, None)
        assert torch.unique(centres, dim=0).shape[0] == 4
        assert bool((torch.cdist(centres, points).amin(1) == 0).all())
    points, masses, generator = torch.eye(3), torch.tensor([1.0, 2.0, 5.0]).double(), seeded()
    for kind, expected in (("centroidal", masses / 8), ("random", torch.full((3,), 1 / 3))):
        drawn = torch.stack([first_centres(points, masses, 1, kind, generator)[0] for _ in range(2000)])
        assert torch.allclose(drawn.mean(0), expected.float(), atol=0.05)
    unlikely = torch.tensor([1.0, 1.0, 0.0]).double()
    for _ in range(20):
        assert float(first_centres(points, unlikely, 2, "centroidal", generator)[:, 2].sum()) == 0.0


def test_a_neighbourhood_without_importance_stays():
    still = published_step(torch.eye(3), torch.zeros(3).double(), alpha=0.5, neighbours=2)
    assert torch.equal(still, torch.eye(3))


def test_imbalance_is_the_population_deviation_of_the_normalised_weights():
    assert imbalance(torch.tensor([2.0, 4.0])) == pytest.approx(0.25)
    assert imbalance(torch.tensor([3.0, 3.0, 3.0])) == 0.0
    assert imbalance(torch.tensor([5.0])) == 0.0
    refuses("positive value", imbalance, torch.zeros(3))
    refuses("shape [k]", imbalance, torch.zeros(0))


POINTS, ONES = torch.rand(9, 3), torch.ones(9)
NAN = float("nan")


@pytest.mark.parametrize(
    ("points", "importance", "k", "options", "error", "message"),
    [
        (POINTS, ONES, 0, {}, ValueError, "k must be at least 1 and steps at least 0, got 0"),
        (POINTS, ONES, 10, {}, ValueError, "number of distinct points, 9, got 10"),
        (torch.zeros(0, 3), torch.zeros(0), 1, {}, ValueError, "positive finite sum"),
        (POINTS, torch.zeros(9), 2, {}, ValueError, "positive finite sum, got 0"),
        (POINTS, ONES * NAN, 2, {}, ValueError, "importance must be finite"),
        (POINTS * NAN, ONES, 2, {}, ValueError, "points must be finite"),
        (POINTS, -ONES, 2, {}, ValueError, "must not be negative, got -1"),
        (POINTS[0], ONES, 2, {}, ValueError, "shape [m, d], d = 1 to 4, got [3]"),
        (POINTS, ONES[:4], 2, {}, ValueError, "importance must have shape [9], got [4]"),
        (POINTS.long(), ONES, 2, {}, TypeError, "points must be floating-point"),
        (POINTS, ONES.int(), 2, {}, TypeError, "importance must be floating-point"),
        (POINTS, ONES, 2, {"centres": "grid"}, ValueError, "balanced, random, uniform, centroidal, got 'grid'"),
        (POINTS, ONES, 2, {"steps": -1}, ValueError, "steps at least 0, got 2 and -1"),
    ],
)
def test_bad_input_gets_one_clear_line(points, importance, k, options, error, message):
    refuses(message, balance, points, importance, k, error=error, **options)


def blobs(seed=0, m=2000):
    """Returns samples in three clumps, and their importance, which grows along the x axis."""
    generator = seeded(seed)
    places = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 4, 1]])
    points = places[torch.randint(3, (m,), generator=generator)] + 0.4 * torch.randn(m, 3, generator=generator)
    return points, (0.5 * points[:, 0]).exp() * (0.5 + torch.rand(m, generator=generator))


def centroids(points, importance, result):
    """Returns the weighted centroids, float64 [k, 3], computed in a loop over the cells."""
    cells = VoronoiDiagram(result.centres).locate(points)
    results = []
    for cell in range(result.centres.shape[0]):
        inside = cells == cell
        masses = importance[inside].double()[:, None]
        results.append((masses * points[inside].double()).sum(0) / masses.sum())
    return torch.stack(results)


def test_lloyd_is_the_plain_loop():
    points, importance = blobs(m=300)
    start = centres = points[:7]
    for _ in range(200):
        nearest = torch.cdist(points.double(), centres.double()).argmin(1)
        moved = []
        for cell in range(7):
            weights = importance[nearest == cell].double()[:, None]
            moved.append((weights * points[nearest == cell].double()).sum(0) / weights.sum())
        centres = torch.stack(moved).float()
    torch.testing.assert_close(lloyd(points, importance.double(), start), centres, rtol=0, atol=1e-4)


@pytest.mark.parametrize("k", [1, 2, 64])
def test_centres_are_the_weighted_centroids_of_their_cells(k):
    points, importance = blobs()
    result = balance(points, importance, k, centres="centroidal", generator=seeded(1))
    expected = centroids(points, importance, result)
    apart = float((result.centres - expected).norm(dim=1).max())
    assert bool((result.after > 0).all()) and apart < 0.02
    # The unweighted centroids lie elsewhere.
    unweighted = balance(points, torch.ones_like(importance), k, centres="centroidal", generator=seeded(1))
    assert float((unweighted.centres - result.centres).norm(dim=1).max()) > 0.02


def test_a_cell_without_samples_goes_to_the_sample_that_costs_most():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [10, 0, 0], [12, 0, 0]])
    centres = torch.tensor([[0.5, 0, 0], [100.0, 0, 0]])
    result = lloyd(points, torch.tensor([1.0, 1, 1, 1]).double(), centres)
    assert torch.equal(result, torch.tensor([[0.5, 0, 0], [11, 0, 0]]))
    # The samples at 0 and 1 cost 400 * 0.25 each; the sample at 10 costs only 1 * 90.25.
    result = lloyd(points[:3], torch.tensor([400.0, 400, 1]).double(), centres)
    assert torch.equal(torch.sort(result[:, 0]).values[:1], torch.zeros(1))
    # Two empty cells move to different places; a cell stays if no move would reduce the cost.
    result = lloyd(points, torch.ones(4).double(), torch.tensor([[0.5, 0, 0], [100.0, 0, 0], [200.0, 0, 0]]))
    assert len({tuple(row) for row in result.tolist()}) == 3 and float(result.max()) <= 12
    result = lloyd(torch.zeros(3, 3), torch.ones(3).double(), torch.tensor([[0.0, 0, 0], [5, 0, 0]]))
    assert torch.equal(result, torch.tensor([[0.0, 0, 0], [5, 0, 0]]))


def test_more_centres_than_samples_of_mass_end_at_once(monkeypatch):
    """The search stops if no sample has a cost that the remaining centres could reduce."""
    points, looks = torch.rand(60, 3, generator=seeded(0)), []
    masses = torch.zeros(60).double()
    masses[:5] = 1.0
    find = ops.nearest_centre
    monkeypatch.setattr(ops, "nearest_centre", lambda *arguments, **how: looks.append(1) or find(*arguments, **how))
    assert torch.equal(lloyd(points, masses, points[:30]), points[:30])
    assert len(looks) == 1


def test_nested_cells_are_centroidal_among_the_samples_of_their_parent():
    points, importance = blobs()
    root = VoronoiDiagram(torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 4, 1]]))
    split = split_diagram(root, points, importance, 8, centres="centroidal", generator=seeded(1))
    assert split.diagram.num_cells == 24
    parents = root.locate(points)
    for cell, result in split.balances.items():
        inside = parents == cell
        expected = centroids(points[inside], importance[inside], result)
        cells = VoronoiDiagram(result.centres).locate(points[inside]).long()
        radius = (points[inside].double() - expected[cells]).norm(dim=1).mean()
        off = (result.centres - expected).norm(dim=1)
        assert float(off.median()) < 0.3 * float(radius)
