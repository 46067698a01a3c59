"""Nested Voronoi diagrams against a slow descent for one point at a time."""

import copy
import io
import math
import pickle

import pytest
import torch
from helpers import refuses, seeded

from voronerf.diagram import VoronoiDiagram, uniform_centres


def slow_locate(diagram, point):
    """Descends the tables of a diagram with Python numbers; ties, and points not finite, go to the first centre."""
    offsets, child = diagram.child_offsets.tolist(), diagram.child.tolist()
    centres = diagram.centres.double().tolist()
    node = 0
    while True:
        rows = range(offsets[node], offsets[node + 1])
        costs = [sum((float(a) - b) ** 2 for a, b in zip(point, centres[row])) for row in rows]
        row = rows[costs.index(min(costs))]
        if child[row] < 0:
            return -1 - child[row]
        node = child[row]


def uneven_diagram():
    """Returns a diagram of three levels with 4 + 3 - 1 + 5 - 1 = 10 leaves; its integer coordinates make ties exact."""
    generator = seeded(3)

    def centres(k):
        return torch.randint(-8, 9, (k, 3), generator=generator).float()

    first, _ = VoronoiDiagram(centres(4)).refine({2: centres(3)})
    second, _ = first.refine({3: centres(5)})
    return second


def integer_points(n):
    return torch.randint(-9, 10, (n, 3), generator=seeded(5)).float()


def test_nested_locate_equals_a_slow_descent():
    diagram, points = uneven_diagram(), integer_points(403)
    points[400], points[401], points[402, 1] = float("nan"), float("inf"), float("nan")
    assert (diagram.depth, diagram.num_cells) == (3, 10)
    other, _ = VoronoiDiagram(integer_points(4)).refine({1: integer_points(7)[4:]})
    for tree in (diagram, other):
        assert tree.locate(points).tolist() == [slow_locate(tree, point) for point in points]


def test_locate_keeps_leading_shapes_and_takes_any_layout_and_dtype():
    diagram, points = uneven_diagram(), integer_points(24)
    expected = diagram.locate(points)
    assert torch.equal(diagram.locate(points.reshape(2, 3, 4, 3)), expected.reshape(2, 3, 4))
    assert diagram.locate(points[0]).shape == ()
    assert torch.equal(diagram.locate(points.T.contiguous().T), expected)
    assert diagram.locate(torch.empty(0, 3)).shape == (0,)
    assert diagram.locate(torch.empty(5, 0, 3)).shape == (5, 0)
    for dtype in (torch.float16, torch.bfloat16, torch.float64):
        assert torch.equal(diagram.locate(points.to(dtype)), expected)


def test_refine_keeps_the_other_cells_and_puts_children_in_place_of_their_parent():
    diagram, points = VoronoiDiagram(integer_points(4)), integer_points(300)
    refined, parents = diagram.refine({2: integer_points(3) + 1, 0: integer_points(2)})
    assert parents.tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert parents.dtype == torch.int64
    assert torch.equal(parents[refined.locate(points).long()], diagram.locate(points).long())
    assert torch.equal(refined.leaf_centres[[2, 6]], diagram.centres[[1, 3]])
    assert torch.equal(refined.leaf_centres[3:6], integer_points(3) + 1)
    assert refined.paths().tolist() == [[0, 0], [0, 1], [1, -1], [2, 0], [2, 1], [2, 2], [3, -1]]

    deeper, grandparents = refined.refine({4: integer_points(2)})
    assert deeper.depth == 3
    assert grandparents.tolist() == [0, 1, 2, 3, 4, 4, 5, 6]
    assert torch.equal(grandparents[deeper.locate(points).long()], refined.locate(points).long())
    assert deeper.paths()[4:6].tolist() == [[2, 1, 0], [2, 1, 1]]


def test_refine_grafts_whole_diagrams():
    inner, root, points = uneven_diagram(), VoronoiDiagram(integer_points(3)), integer_points(300)
    grafted, parents = root.refine({1: inner})
    assert (grafted.depth, grafted.num_cells) == (4, 12)
    outer = root.locate(points)
    expected = torch.where(outer == 1, 1 + inner.locate(points), torch.where(outer == 2, 11, 0))
    assert torch.equal(grafted.locate(points), expected.int())
    assert parents.tolist() == [0, *[1] * 10, 2]


def test_a_diagram_of_one_cell_is_legal_and_is_replaced_when_refined():
    single = VoronoiDiagram(torch.zeros(1, 3))
    assert single.locate(integer_points(5)).tolist() == [0] * 5
    refined, parents = single.refine({0: integer_points(6)})
    assert (refined.depth, refined.num_cells, parents.tolist()) == (1, 6, [0] * 6)
    nested, _ = single.refine({0: uneven_diagram()})
    assert nested.depth == 3
    same, parents = refined.refine({3: torch.zeros(1, 3)})
    assert (same.depth, same.num_cells, parents.tolist()) == (1, 6, list(range(6)))
    unchanged, parents = refined.refine({})
    assert torch.equal(unchanged.centres, refined.centres)
    assert parents.tolist() == list(range(6))


def test_refine_leaves_the_diagram_it_is_called_on_alone():
    centres = integer_points(4)
    diagram = VoronoiDiagram(centres)
    before = {name: table.clone() for name, table in diagram.state_dict().items()}
    centres += 1
    for children in ({}, {1: integer_points(2)}):
        refined, _ = diagram.refine(children)
        refined.centres.zero_()
        refined.child.zero_()
    single = VoronoiDiagram(torch.zeros(1, 3))
    replaced, _ = single.refine({0: diagram})
    replaced.centres.zero_()
    for name, table in diagram.state_dict().items():
        assert torch.equal(table, before[name])


@pytest.mark.parametrize(
    ("centres", "error", "message"),
    [
        (torch.zeros(0, 3), ValueError, "at least one centre"),
        (torch.zeros(4, 5), ValueError, "shape [k, d], d = 1 to 4, got [4, 5]"),
        (torch.zeros(3), ValueError, "shape [k, d], d = 1 to 4, got [3]"),
        (torch.tensor([[0.0, float("nan"), 0.0]]), ValueError, "must be finite"),
        (torch.zeros(4, 3, dtype=torch.int32), TypeError, "floating-point"),
        ([[0.0, 0.0, 0.0]], TypeError, "floating-point tensor, got list"),
    ],
)
def test_what_is_no_diagram_is_refused(centres, error, message):
    refuses(message, VoronoiDiagram, centres, error=error)


def test_refine_refuses_what_is_no_leaf():
    refine, two = VoronoiDiagram(integer_points(4)).refine, integer_points(2)
    refuses("leaves 0..3, got 4", refine, {4: two})
    refuses("got -1", refine, {-1: two})
    refuses("each leaf once, got 1 twice", refine, {1: two, torch.tensor(1): two})
    refuses("at least one centre", refine, {1: torch.zeros(0, 3)})
    refuses("children must have centres [k, 3], got [k, 2]", refine, {1: torch.zeros(2, 2)})
    refuses("", refine, {1.5: two}, error=TypeError)


def test_points_of_another_shape_or_type_are_refused():
    diagram = uneven_diagram()
    refuses("points must have shape [..., 3], got [4, 2]", diagram.locate, torch.zeros(4, 2))
    wrong = torch.zeros(4, 3, dtype=torch.int64)
    refuses("floating-point, got torch", diagram.sample_cell, wrong, temperature=1.0, error=TypeError)


def test_copies_pickles_and_states_are_the_same_diagram():
    diagram, _ = uneven_diagram().refine({7: integer_points(3)})
    points = integer_points(200)
    expected = diagram.locate(points)
    other = VoronoiDiagram(torch.zeros(2, 3))
    other.load_state_dict(diagram.state_dict())
    holder = torch.nn.ModuleDict({"diagram": VoronoiDiagram(torch.zeros(1, 3))})
    holder.load_state_dict({f"diagram.{name}": table for name, table in diagram.state_dict().items()})
    file = io.BytesIO()
    torch.save(diagram.state_dict(), file)
    file.seek(0)
    loaded = VoronoiDiagram.from_state(torch.load(file, weights_only=True))
    prefixed = VoronoiDiagram.from_state(holder.state_dict(), "diagram.")
    copies = copy.deepcopy(diagram), pickle.loads(pickle.dumps(diagram))
    for same in (*copies, other, holder["diagram"], loaded, prefixed):
        assert torch.equal(same.locate(points), expected)
        assert (same.depth, same.num_cells) == (diagram.depth, diagram.num_cells)


def test_damaged_states_are_refused():
    state = uneven_diagram().state_dict()
    child = state["child"]
    del state["child"]
    refuses("state must hold child", VoronoiDiagram.from_state, state)
    for damage, message in (
        ({"child": torch.where(child == 1, 0, child)}, "refer to each diagram once"),
        ({"child": torch.where(child == -1, -2, child)}, "number the leaves depth-first"),
        ({"child_offsets": state["child_offsets"][:-1]}, "cover all 12 centres"),
        ({"centres": state["centres"] / 0}, "must be finite"),
        ({"child": child.long()}, "int32"),
    ):
        refuses(message, VoronoiDiagram.from_state, {**state, "child": child, **damage})


def test_centres_are_not_rounded_when_a_model_changes_its_dtype():
    diagram = VoronoiDiagram(torch.rand(5, 3))
    centres = diagram.centres.clone()
    for convert in (lambda d: d.half(), lambda d: d.to(torch.bfloat16), lambda d: d.double(), lambda d: d.to("cpu")):
        moved = convert(diagram)
        assert moved.centres.dtype == torch.float32
        assert torch.equal(moved.centres, centres)


def test_stochastic_assignment_is_the_softmax_of_the_distances_along_the_path():
    root = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
    inner = torch.tensor([[1.0, 1, 0], [1, -1, 0], [2, 0, 0]])
    diagram, _ = VoronoiDiagram(root).refine({1: inner})
    point, n = torch.tensor([0.6, 0.3, 0.0]), 20_000
    drawn = diagram.sample_cell(point.expand(n, 3), temperature=0.5, generator=seeded(1))
    level = [torch.softmax(-(point - centres).norm(dim=1) / 0.5, 0) for centres in (root, inner)]
    expected = torch.cat([level[0][:1], level[0][1] * level[1]])
    frequencies = torch.bincount(drawn, minlength=4) / n
    # The tolerance is five standard deviations of a binomial frequency.
    assert bool(((frequencies - expected).abs() < 5 * (expected * (1 - expected) / n).sqrt()).all())


def test_stochastic_assignment_becomes_the_nearest_cell_as_the_temperature_falls():
    diagram = uneven_diagram()
    points = torch.randn(500, 3, generator=seeded(2)) * 6
    nearest = diagram.locate(points)
    assert torch.equal(diagram.sample_cell(points, temperature=0.0), nearest)
    drawn = diagram.sample_cell(points, temperature=1e-6)
    assert drawn.dtype == torch.int32
    assert int((drawn != nearest).sum()) <= 1
    again = [diagram.sample_cell(points, temperature=9.0, generator=seeded(4)) for _ in "ab"]
    assert torch.equal(*again)
    assert not torch.equal(again[0], nearest)
    assert diagram.sample_cell(torch.empty(0, 2, 3), temperature=1.0).shape == (0, 2)
    refuses("temperature must be finite and at least 0, got -1", diagram.sample_cell, points, temperature=-1.0)


def test_stochastic_assignment_draws_on_the_generators_device():
    diagram, points = uneven_diagram().to("meta"), torch.randn(50, 3, device="meta")
    drawn = diagram.sample_cell(points, temperature=1.0, generator=seeded(2))
    assert drawn.device.type == "meta" and drawn.shape == (50,)


@pytest.mark.parametrize("sides", [(4,), (4, 4), (2, 2, 2, 2), (2, 2, 2), (3, 3, 3), (2, 2, 3), (4, 2, 2)])
def test_uniform_centres_of_a_cube_are_a_grid(sides):
    k, d = math.prod(sides), len(sides)
    expected = torch.cartesian_prod(*[(torch.arange(side) + 0.5) * 2 / side - 1 for side in sides]).view(k, d)
    centres = uniform_centres(torch.tensor([[-1.0] * d, [1.0] * d]), k)
    assert torch.allclose(torch.cdist(centres, expected).amin(1), torch.zeros(k), atol=1e-3)
    assert torch.unique(centres, dim=0).shape[0] == k


@pytest.mark.parametrize("k", [1, 2, 7, 13, 257])
def test_uniform_centres_of_any_number_lie_apart_in_the_box(k):
    box = torch.tensor([[0.0, -1, 2], [4, 1, 2.5]])
    centres = uniform_centres(box, k)
    assert centres.shape == (k, 3)
    assert bool(((centres > box[0]) & (centres < box[1])).all())
    assert torch.unique(centres, dim=0).shape[0] == k
    # The box is cut into k parts of equal volume, one for each centre, so cells get about equal numbers of points.
    points = box[0] + torch.rand(20_000, 3, generator=seeded(0)) * (box[1] - box[0])
    counts = torch.bincount(VoronoiDiagram(centres).locate(points), minlength=k) * k / points.shape[0]
    assert float(counts.max()) < 2.2
    assert float(counts.min()) > 0.35


def test_uniform_centres_of_a_flat_box_and_of_no_box():
    flat = uniform_centres(torch.tensor([[0.0, 0, 1], [2, 2, 1]]), 4)
    assert bool((flat[:, 2] == 1).all())
    refuses("k must be at least 1, got 0", uniform_centres, torch.zeros(2, 3), 0)
    refuses("shape [2, d], d = 1 to 4, got [3, 2]", uniform_centres, torch.zeros(3, 2), 4)
    refuses("box[0] <= box[1]", uniform_centres, torch.tensor([[1.0, 0, 0], [0, 1, 1]]), 4)
