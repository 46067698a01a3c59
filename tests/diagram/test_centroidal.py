"""Weighted, re-seeded and nested centroidal centres, compared with a plain loop."""

import sys

import pytest
import torch
from helpers import seeded

from voronerf import ops
from voronerf.diagram import VoronoiDiagram, balance, split_diagram
from voronerf.diagram.balance import lloyd

balance_module = sys.modules["voronerf.diagram.balance"]  # the package also has a function named `balance`


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


@pytest.mark.parametrize("k", [1, 2, 16, 64])
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
