"""Blended cells: the weights against a slow search, their limits, and that nothing jumps."""

import math

import pytest
import torch
from helpers import refuses, same, seeded

from voronerf import VoronoiDiagram
from voronerf.diagram.blending import blend_cells


def diagram_of(kind):
    generator = seeded()

    def of(k):
        return VoronoiDiagram(torch.rand(k, 3, generator=generator) * 2 - 1)

    if kind == "nested":
        nested, _ = of(5).refine({0: of(3), 2: of(4), 4: of(2)})
        return nested.refine({1: of(3)})[0]
    if kind == "same":
        return VoronoiDiagram(of(3).centres.repeat(2, 1))
    return of(1 if kind == "one" else 12)


KINDS = ("flat", "same", "nested")


def slow_leaves(diagram, x, margin):
    """Weights of all leaves of one point, by the definition."""
    offsets, child = diagram.child_offsets.tolist(), diagram.child.tolist()
    centres = diagram.centres.double().tolist()
    point = x.double().tolist()
    found = {}

    def inside(i, rows):
        """How far the point is on the side of centre i, from the plane that is nearest."""
        least = math.inf
        for j in rows:
            apart = math.dist(centres[i], centres[j])
            lead = math.dist(point, centres[j]) ** 2 - math.dist(point, centres[i]) ** 2
            if apart > 0:
                least = min(least, lead / (2 * apart))
            elif i != j and (lead, j) < (0, i):
                least = -math.inf
        return least

    def descend(node, weight):
        rows = range(offsets[node], offsets[node + 1])
        shares = {i: min(max(0.5 + inside(i, rows) / (2 * margin), 0.0), 1.0) for i in rows}
        for i in rows:
            share = weight * shares[i] / sum(shares.values())
            if share > 0 and child[i] < 0:
                found[-1 - child[i]] = share
            elif share > 0:
                descend(child[i], share)

    descend(0, 1.0)
    return found


def weights_of(blend, diagram, points):
    """[n, cells], the leaf that holds a point where it is in no margin."""
    table = torch.zeros(points.shape[0], diagram.num_cells, dtype=points.dtype)
    table[torch.arange(points.shape[0]), diagram.locate(points).long()] = 1
    table[blend.rows] = 0
    return table.index_put_((blend.rows, blend.cells.long()), blend.weights, accumulate=True)


@pytest.mark.parametrize("margin", [0.02, 0.3])
@pytest.mark.parametrize("kind", KINDS)
def test_against_the_definition(kind, margin):
    diagram = diagram_of(kind)
    points = torch.rand(300, 3, dtype=torch.float64) * 2.4 - 1.2
    found = weights_of(blend_cells(diagram, points, margin, most=diagram.num_cells), diagram, points)
    for point, row in zip(points, found):
        expected = torch.zeros_like(row)
        for leaf, weight in slow_leaves(diagram, point, margin).items():
            expected[leaf] = weight
        assert torch.allclose(row, expected, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_entries_are_sorted_few_and_sum_to_one(kind):
    diagram, points = diagram_of(kind), torch.rand(5000, 3) * 2.4 - 1.2
    blend = blend_cells(diagram, points, 0.25, most=3)
    assert blend.rows.numel() > 1000 and (blend.rows.diff() >= 0).all() and (blend.weights > 0).all()
    assert blend.cells.dtype == torch.int32 and blend.cells.unique().tolist()[-1] < diagram.num_cells
    assert (blend.cells >= 0).all()
    sums = torch.zeros(5000).index_add_(0, blend.rows, blend.weights)
    assert torch.allclose(sums[sums > 0], torch.ones(int((sums > 0).sum())), atol=1e-5)
    assert int(blend.rows.bincount().max()) == 3
    same_row = blend.rows.diff() == 0
    assert (blend.weights.diff()[same_row] <= 0).all()
    # the nearest leaf of a flat diagram is the heaviest
    if diagram.depth == 1:
        first = torch.cat([torch.tensor([True]), ~same_row])
        assert torch.equal(blend.cells[first], diagram.locate(points[blend.rows[first]]))


@pytest.mark.parametrize("kind", KINDS)
def test_points_beyond_the_margin_have_no_entry(kind):
    diagram, margin = diagram_of(kind), 0.05
    points = torch.rand(400, 3, dtype=torch.float64) * 2.4 - 1.2
    inside = torch.zeros(400, dtype=torch.bool)
    inside[blend_cells(diagram, points, margin).rows] = True
    # Walking a margin into any direction changes the leaf of a point in a margin only.
    steps = torch.nn.functional.normalize(torch.randn(2000, 3, dtype=torch.float64), dim=1) * margin
    own = diagram.locate(points)
    crosses = torch.stack([(diagram.locate(points[i] + steps) != own[i]).any() for i in range(400)])
    assert not (crosses & ~inside).any()
    assert inside.sum() > 20 and (~inside).sum() > 20


@pytest.mark.parametrize("most", [2, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_jumps_across_borders(kind, most):
    diagram, margin = diagram_of(kind), 0.1
    start = torch.rand(40, 1, 3, dtype=torch.float64) * 2.4 - 1.2
    end = torch.rand(40, 1, 3, dtype=torch.float64) * 2.4 - 1.2
    count = 4000
    line = start + (end - start) * torch.linspace(0, 1, count, dtype=torch.float64)[None, :, None]
    points = line.reshape(-1, 3)
    table = weights_of(blend_cells(diagram, points, margin, most=most), diagram, points)
    jump = table.reshape(40, count, -1).diff(dim=1).abs().amax((1, 2))
    crossings = (diagram.locate(points).reshape(40, count).diff(dim=1) != 0).sum()
    assert crossings > 10
    # A step is at most 4 / count long; u has the slope 1 / (2 M), which dividing by sums makes steeper. A point where
    # more leaves meet than answer may be steep at any scale: a few of the lines may pass one by chance.
    bound = 40 * (4 / count) / (2 * margin)
    assert float(jump.median()) < bound and int((jump > 10 * bound).sum()) <= (3 if most == 2 else 0)


def test_nothing_to_blend():
    points = torch.rand(50, 3)
    for diagram, margin in ((diagram_of("flat"), 0.0), (diagram_of("one"), 1.0)):
        assert blend_cells(diagram, points, margin).rows.numel() == 0
    assert blend_cells(diagram_of("nested"), points[:0], 0.1).cells.shape == (0,)
    bad = torch.tensor([[math.nan, 0, 0], [math.inf, 0, 0]])
    assert blend_cells(diagram_of("nested"), bad, 0.1).rows.numel() == 0
    halves = blend_cells(diagram_of("flat"), points.half(), 0.1)
    assert torch.equal(halves.cells, blend_cells(diagram_of("flat"), points.half().float(), 0.1).cells)


def test_one_leaf_is_the_nearest():
    diagram, points = diagram_of("flat"), torch.rand(500, 3) * 2 - 1
    blend = blend_cells(diagram, points, 0.2, most=1)
    assert torch.equal(blend.cells, diagram.locate(points[blend.rows])) and (blend.weights == 1).all()


def test_large_batches_go_in_pieces(monkeypatch):
    diagram, points = diagram_of("nested"), torch.rand(1000, 3) * 2 - 1
    whole = blend_cells(diagram, points, 0.2)
    monkeypatch.setattr("voronerf.diagram.blending._CHUNK_ELEMENTS", 500)
    assert same(whole, blend_cells(diagram, points, 0.2))


def test_bad_arguments():
    diagram = diagram_of("flat")
    refuses("points must be floating [n, 3], got torch.float32 [2, 2]", blend_cells, diagram, torch.zeros(2, 2), 0.1)
    for margin in (-0.1, math.inf, math.nan):
        refuses("margin must be finite and at least 0, got", blend_cells, diagram, torch.zeros(2, 3), margin)
    refuses("most must be at least 1, got 0", blend_cells, diagram, torch.zeros(2, 3), 0.1, most=0)
