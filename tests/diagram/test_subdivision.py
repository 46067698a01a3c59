"""Tests that cells are split by the samples inside them."""

import pytest
import torch
from helpers import refuses, seeded

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.balance import cell_weights, imbalance
from voronerf.diagram.subdivision import split_diagram
from voronerf.router import VoronoiRouter

ROOT = VoronoiDiagram(torch.tensor([[-2.0, 0, 0], [0, 0, 0], [2, 0, 0]]))


def three_clouds(counts=(600, 300, 5)):
    """Returns samples in each of ROOT's three cells; samples of the middle cell weigh 4 times as much."""
    generator = seeded()
    points = torch.randn(sum(counts), 3, generator=generator) * 0.2
    cell = torch.repeat_interleave(torch.arange(3), torch.tensor(counts))
    importance = (0.5 + torch.rand(sum(counts), generator=generator)) * torch.tensor([1.0, 4.0, 1.0])[cell]
    order = torch.randperm(sum(counts), generator=generator)
    return (points.clamp(-0.9, 0.9) + ROOT.centres[cell])[order], importance[order]


def test_the_first_split_replaces_the_single_cell():
    points, importance = three_clouds()
    split = split_diagram(VoronoiDiagram(torch.zeros(1, 3)), points, importance, 6, generator=seeded(1))
    assert (split.diagram.depth, split.diagram.num_cells) == (1, 6)
    assert split.parents.tolist() == [0] * 6
    assert torch.equal(split.diagram.centres, split.balances[0].centres)


def test_every_cell_is_balanced_by_its_own_samples_and_small_cells_stay_leaves():
    points, importance = three_clouds()
    split = split_diagram(ROOT, points, importance, 8, centres="balanced", generator=seeded(1))
    assert sorted(split.balances) == [0, 1]
    assert split.parents.tolist() == [0] * 8 + [1] * 8 + [2]
    weights = cell_weights(split.diagram.locate(points), importance, split.diagram.num_cells)
    for cell, result in split.balances.items():
        assert torch.allclose(weights[split.parents == cell], result.after)
        assert result.imbalance_after < 0.03 < result.imbalance_before
    assert float(weights[16]) == pytest.approx(float(importance[ROOT.locate(points) == 2].double().sum()))


def test_only_the_worst_cell():
    points, importance = three_clouds()
    split = split_diagram(ROOT, points, importance, 4, cells="worst", generator=seeded(1))
    assert split.parents.tolist() == [0, 1, 1, 1, 1, 2]
    # Only cells with enough samples can be the worst, even if another cell has one sample of huge weight.
    heavy = torch.cat([points, torch.tensor([[2.0, 0, 0]])]), torch.cat([importance, torch.tensor([1e6])])
    split = split_diagram(ROOT, *heavy, 8, cells="worst", generator=seeded(1))
    assert sorted(split.balances) == [1]


def test_named_cells_and_minimum_of_samples():
    points, importance = three_clouds()
    assert sorted(split_diagram(ROOT, points, importance, 4, cells=[2, 0]).balances) == [0, 2]
    assert sorted(split_diagram(ROOT, points, importance, 4, cells=torch.tensor([1])).balances) == [1]
    assert sorted(split_diagram(ROOT, points, importance, 4, min_samples=400).balances) == [0]
    untouched = split_diagram(ROOT, points, importance, 4, min_samples=4000)
    assert untouched.diagram is ROOT
    assert untouched.parents.tolist() == [0, 1, 2]
    assert split_diagram(ROOT, points, importance, 1).diagram is ROOT
    assert split_diagram(ROOT, points, importance, 4, cells=[]).diagram is ROOT


def test_just_enough_samples_are_enough():
    """A cell splits if it has at least as many distinct samples as children, and at least the minimum of samples."""
    root = VoronoiDiagram(torch.tensor([[0.0, 0, 0], [10.0, 0, 0]]))
    points = torch.cat((torch.rand(4, 3, generator=seeded(2)), torch.rand(3, 3, generator=seeded(3)) + root.centres[1]))
    split = split_diagram(root, points, torch.ones(7), 4, generator=seeded(1))
    assert list(split.balances) == [0]
    split = split_diagram(root, points, torch.ones(7), 2, min_samples=4, generator=seeded(1))
    assert list(split.balances) == [0]


def test_samples_at_one_place_or_without_importance_do_not_count():
    points, importance = three_clouds((50, 50, 50))
    cells = ROOT.locate(points)
    points[cells == 0] = torch.tensor([-2.0, 0, 0])
    importance[cells == 1] = 0.0
    assert sorted(split_diagram(ROOT, points, importance, 4).balances) == [2]


def test_random_centres_are_samples_of_their_cell():
    points, importance = three_clouds()
    split = split_diagram(ROOT, points, importance, 5, centres="random", generator=seeded(1))
    assert torch.equal(ROOT.locate(split.diagram.leaf_centres[:-5]), split.parents[:-5].int())
    assert bool((torch.cdist(split.balances[0].centres, points).amin(1) < 1e-3).all())
    assert split.balances[0].imbalance_before == split.balances[0].imbalance_after


def test_uniform_centres_fill_the_box_of_their_cells_samples():
    points, importance = three_clouds()
    split = split_diagram(ROOT, points, importance, 8, centres="uniform")
    inside = points[ROOT.locate(points) == 1]
    low, high = inside.amin(0), inside.amax(0)
    centres = split.balances[1].centres
    for axis in range(3):
        quarters = low[axis] + (high - low)[axis] * torch.tensor([0.25, 0.75])
        assert torch.allclose(torch.unique(centres[:, axis]), quarters)


def test_options_reach_the_balancing_and_depth_grows():
    points, importance = three_clouds()
    split = split_diagram(ROOT, points, importance, 16, centres="balanced", steps=0, cells=[0], generator=seeded(1))
    assert split.balances[0].imbalance_after == split.balances[0].imbalance_before > 0.1
    deeper = split_diagram(split.diagram, points, importance, 3, min_samples=20, steps=30, generator=seeded(1))
    assert deeper.diagram.depth == 3
    located = deeper.diagram.locate(points).long()
    assert torch.equal(deeper.parents[located], split.diagram.locate(points).long())
    assert imbalance(deeper.balances[1].after) == deeper.balances[1].imbalance_after


def test_bad_input_gets_one_clear_line():
    points, importance = three_clouds((2, 2, 2))
    for arguments, message in (
        ({"k": 0}, "k must be at least 1, got 0"),
        ({"k": 7}, "more cells than samples"),
        ({"k": 2, "cells": [3]}, "cells must name cells 0..2, each once, got [3]"),
        ({"k": 2, "cells": [1, 1]}, "each once"),
        ({"k": 2, "cells": "best"}, "got 'best'"),
        ({"k": 2, "centres": "grid"}, "centres must be one of balanced, random, uniform, centroidal, got 'grid'"),
    ):
        refuses(message, split_diagram, ROOT, points, importance, **arguments)
    refuses("points must have shape [..., 3], got [6, 2]", split_diagram, ROOT, points[:, :2], importance, 2)
    refuses("split_diagram: importance must be finite", split_diagram, ROOT, points, importance / 0 * 0, 2)
    refuses("more cells than samples", split_diagram, ROOT, torch.zeros(0, 3), torch.zeros(0), 2)
    router = VoronoiRouter(torch.nn.Linear(3, 1), torch.zeros(1, 3), coords="first3")
    for children, shape, weights, message in (
        (0, (6, 3), 6, "diagram must be at least 1 child for a cell, got 0"),
        (4, (6, 2), 6, "points must have shape [m, 3], got [6, 2]"),
        (4, (6, 3), 5, "weights must have shape [6], got [5]"),
    ):
        samples = {"points": torch.rand(shape), "weights": torch.ones(weights)}
        refuses(f"VoronoiRouter.subdivide: {message}", router.subdivide, children, **samples)
