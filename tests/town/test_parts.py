"""Parts: several routers in one scene, each in its own frame."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refuses

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.nerf import Contraction
from voronerf.nerf.fields import HashGridField
from voronerf.town.parts import Part, Parts, Similarity, Solid


@pytest.fixture
def torch_seed():
    torch.manual_seed(0)


def hashed(k: int, shift: float = 0.0, width: int = 8) -> VoronoiRouter:
    """A router on a shared table, whose cells differ."""
    router = VoronoiRouter(
        HashGridField(width=width, log2_entries=10, levels=2),
        torch.rand(k, 3) + torch.tensor([shift, 0, 0]),
        share=["features"],
    )
    return differ(router)


def plain(k: int, shift: float = 0.0) -> VoronoiRouter:
    return differ(VoronoiRouter(NeRF(width=8, depth=1), torch.rand(k, 3) + torch.tensor([shift, 0, 0])))


def differ(router: VoronoiRouter) -> VoronoiRouter:
    with torch.no_grad():
        for parameter in router.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    return router.eval()


def queries(n: int = 500, width: float = 2.0):
    directions = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    points = torch.rand(n, 3) * torch.tensor([width, 1, 1])
    return points, directions, torch.randint(0, 20, (n,), dtype=torch.int32)


def close(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool(torch.allclose(a, b, rtol=1e-4, atol=1e-5))


def test_one_part_gives_the_bits_of_its_router(torch_seed) -> None:
    router, asked = hashed(5), queries()
    alone = router(*asked)
    for parts in (Parts([Part([router])]), Parts([Part([router], region=[Solid.box((-9, -9, -9), (9, 9, 9))])])):
        found = parts.eval()(*asked)
        assert torch.equal(found[0], alone[0]) and torch.equal(found[1], alone[1])
        assert torch.equal(parts.assign(asked[0]), router.assign(asked[0]))


def test_the_nearest_centre_of_all_parts_decides(torch_seed) -> None:
    one, two, asked = hashed(4), plain(7, 1.0), queries()
    parts = Parts([Part([one]), Part([two])]).eval()
    nearest = torch.cdist(asked[0], torch.cat([one.diagram.centres, two.diagram.centres])).argmin(1)
    assert torch.equal(parts.assign(asked[0]).long(), nearest)
    colour, density = parts(*asked)
    first = nearest < 4
    assert 0 < int(first.sum()) < len(first)
    for own, (c, d) in ((first, one(*asked)), (~first, two(*asked))):
        assert close(colour[own], c[own]) and close(density[own], d[own])


@pytest.mark.parametrize("n", [0, 1])
def test_few_points(torch_seed, n: int) -> None:
    parts = Parts([Part([hashed(2)]), Part([plain(3, 1.0)], region=[Solid(ball=(1, 0, 0, 0.1))])]).eval()
    points, directions, index = queries(n)
    colour, density = parts(points, directions, index)
    assert colour.shape == (n, 3) and density.shape == (n,) and parts.assign(points).shape == (n,)


def test_nothing_speaks_for_a_point(torch_seed) -> None:
    parts = Parts([Part([hashed(2)], region=[Solid.box((5, 5, 5), (6, 6, 6))]), Part([plain(2)], owner=None)])
    hidden = torch.tensor([False, False, True, True])
    points, directions, index = queries()
    colour, density = parts.eval().without(hidden)(points, directions, index)
    assert not colour.any() and not density.any()
    assert (parts.without(hidden).assign(points) == -1).all() and (parts.assign(points) >= 2).all()


def test_a_similarity_moves_points_directions_and_densities(torch_seed) -> None:
    router, (points, directions, index) = plain(5), queries()
    frame = Similarity.of((1, -2, 3), (10, 20, 30), 2.5)
    parts = Parts([Part([router], frame=frame)]).eval()
    colour, density = parts(frame.points(points), frame.directions(directions), index)
    wanted = router(points, directions, index)
    assert close(colour, wanted[0]) and close(density * 2.5, wanted[1])


def test_similarities(torch_seed) -> None:
    frame = Similarity.of((1, -2, 3), (10, 20, 30), 2.5)
    points = torch.randn(10, 3, dtype=torch.float64)
    assert torch.allclose(frame.inverse.points(frame.points(points)), points)
    other = Similarity.of((0, 1, 0), (0, 90, 0))
    assert torch.allclose((frame @ other).points(points), frame.points(other.points(points)))
    assert torch.allclose(other.points(torch.tensor([[0.0, 0, 1]])), torch.tensor([[1.0, 1, 0]]), atol=1e-6)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = frame.scale * frame.rotation, frame.translation
    assert torch.allclose(Similarity.of_matrix(matrix.tolist()).points(points), frame.points(points))
    mirror = torch.diag(torch.tensor([1.0, 1, -1]))
    refuses("scale must be positive and finite, got 0", lambda: Similarity(0.0))
    refuses("scale must be positive and finite, got -1", lambda: Similarity(-1.0))
    refuses("must not mirror", lambda: Similarity(1.0, mirror))
    refuses("must be orthonormal", lambda: Similarity(1.0, 2 * torch.eye(3)))
    refuses("translation must be [3] finite", lambda: Similarity(translation=torch.tensor([0, math.nan, 0])))
    refuses("must have shape [4, 4]", lambda: Similarity.of_matrix([[1.0]]))


def test_solids_move_with_their_frames(torch_seed) -> None:
    frame, points = Similarity.of((1, -2, 3), (10, 20, 30), 2.5), torch.randn(2000, 3) * 2
    for solid in (Solid.box((-1, 0, -2), (1, 1, 1)), Solid(ball=(0.5, 0, 0, 1.5))):
        inside = solid.holds(points)
        assert 0 < int(inside.sum()) < 2000
        assert torch.equal(solid.moved(frame).holds(frame.points(points)), inside)
        values = solid.to_values()
        assert Solid.from_values(values) == solid
        assert torch.equal(Solid(solid.planes, solid.ball, outside=True).holds(points), ~inside)
    refuses("second corner above the first", lambda: Solid.box((0, 0, 0), (1, 0, 1)))
    refuses("radius of a ball must be positive", lambda: Solid(ball=(0, 0, 0, 0)))
    refuses("planes of four numbers, or a ball", lambda: Solid())


def test_a_part_whose_cells_have_their_own_router_looks_the_same(torch_seed) -> None:
    router, asked = hashed(4), queries(width=1.0)
    nested, parents = router.diagram.refine({1: torch.rand(3, 3), 2: torch.rand(2, 3)})
    router.subdivide(nested, parents)
    differ(router)
    wanted = router(*asked)
    part = Part([router]).split(torch.tensor([1, 4])).split(torch.tensor([0, 5]))
    assert [one.num_cells for one in part] == [3, 2, 2] and part.num_cells == 7
    parts = Parts([part]).eval()
    found = parts(*asked)
    assert close(found[0], wanted[0]) and close(found[1], wanted[1])
    assert torch.equal(parts.assign(asked[0]), router.assign(asked[0]))
    tables = [id(one.module.features) for one in part]
    assert len(set(tables)) == 3
    refuses("cells must be of one router", lambda: part.split(torch.tensor([0, 1])))
    refuses("cells must be numbers of 0..6", lambda: part.split(torch.tensor([7])))


def test_cells_that_are_cut_away_show_nothing_and_leave_the_others(torch_seed) -> None:
    router, asked = hashed(6), queries(width=1.0)
    part = Part([router]).keep(torch.tensor([1, 4]))
    assert (
        part.num_cells == 2
        and part[0].num_cells == 2
        and Part([router]).keep(torch.tensor([], dtype=torch.int64)) is None
    )
    colour, density = Parts([part]).eval()(*asked)
    cells, wanted = router.assign(asked[0]), router(*asked)
    kept = (cells == 1) | (cells == 4)
    assert torch.equal(colour[kept], wanted[0][kept]) and torch.equal(density[kept], wanted[1][kept])
    assert not density[~kept].any()
    assert part.keep(torch.tensor([1])).leaves.tolist() == [4]


def test_a_hole_goes_to_the_nearest_part_that_speaks(torch_seed) -> None:
    one, two, asked = hashed(6), plain(3), queries(width=1.0)
    hole = Part([one]).keep(torch.tensor([0, 1, 2, 3]))
    parts = Parts([hole, Part([two])]).eval()
    cells = one.assign(asked[0])
    nearest = torch.cdist(asked[0], torch.cat([one.diagram.centres[:4], two.diagram.centres])).argmin(1)
    assert torch.equal(parts.assign(asked[0]) < 4, (nearest < 4) & (cells < 4))
    gone = cells > 3
    assert gone.any()
    assert close(parts(*asked)[1][gone], two(*asked)[1][gone])


def test_layers_add_up(torch_seed) -> None:
    under, above, asked = hashed(3), plain(2), queries(width=1.0)
    ball = Solid(ball=(0.5, 0.5, 0.5, 0.4))
    colour, density = Parts([Part([under]), Part([above], layer=1, region=[ball])]).eval()(*asked)
    (c0, d0), (c1, d1), inside = under(*asked), above(*asked), ball.holds(asked[0])
    assert torch.equal(colour[~inside], c0[~inside]) and torch.equal(density[~inside], d0[~inside])
    assert close(density[inside], (d0 + d1)[inside])
    mixed = (c0 * d0[:, None] + c1 * d1[:, None]) / (d0 + d1)[:, None]
    assert close(colour[inside], mixed[inside])


def test_a_contracted_part_is_asked_in_its_own_space(torch_seed) -> None:
    router, contraction = plain(4), Contraction(torch.zeros(3), 1.0)
    parts = Parts([Part([router], contraction=contraction)]).eval()
    points, directions, index = queries(width=5.0)
    assert close(parts(points, directions, index)[1], router(contraction.points(points), directions, index)[1])


def test_gradients_reach_all_parts(torch_seed) -> None:
    one, two = hashed(3), plain(2, 1.0)
    parts = Parts([Part([one]), Part([two], frame=Similarity.of(scale=1.1))])
    colour, density = parts.train()(*queries())
    (colour.sum() + density.sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in (one.module.features, one.module.density.weight))
    assert all(p.grad is not None for p in two.parameters())


def test_what_a_part_refuses(torch_seed) -> None:
    refuses("owner must have shape [3]", lambda: Part([plain(3)], owner=torch.zeros(2)))
    refuses("owner must name as many leaves", lambda: Part([plain(3)], VoronoiDiagram(torch.rand(4, 3))))
    refuses("at least one in layer 0", lambda: Parts([Part([plain(1)], layer=1)]))


# Routers of one kind --------------------------------------------------------------------------------------------------


def test_routers_are_taken_apart_and_joined(torch_seed) -> None:
    whole, asked = plain(6), queries(width=1.0)
    nested, parents = whole.diagram.refine({0: torch.rand(3, 3)})
    whole.subdivide(nested, parents)
    differ(whole)
    wanted = whole(*asked)
    first, second = whole.part(torch.arange(5)), whole.part(torch.arange(5, 8))
    joined = VoronoiRouter.join(first, second)
    assert joined.num_cells == 8 and joined.diagram.depth == 2
    assert torch.equal(joined(*asked)[0], wanted[0])
    with torch.no_grad():
        next(joined.parameters()).zero_()  # which are copies
    assert torch.equal(whole(*asked)[0], wanted[0])


def test_what_joining_routers_refuses(torch_seed) -> None:
    refuses("at least one, got none", lambda: VoronoiRouter.join())
    refuses("must have shape", lambda: VoronoiRouter.join(hashed(2), hashed(2, width=16)))
    refuses(
        "features of router 1 is shared by its cells and has other values",
        lambda: VoronoiRouter.join(hashed(2), hashed(2)),
    )
    own = VoronoiRouter(HashGridField(width=8, log2_entries=10, levels=2), torch.rand(2, 3))
    refuses("is not shared by its cells", lambda: VoronoiRouter.join(hashed(2), own))
    refuses("router 1 must have shape [3, 8], got [3, 4]", lambda: VoronoiRouter.join(hashed(2), plain(2)))


def test_freezing_follows_cells(torch_seed) -> None:
    router = plain(5)
    router.freeze([1, 3])
    first, second = router.part(torch.tensor([1, 2])), router.part(torch.tensor([0, 3, 4]))
    assert first.frozen.tolist() == [True, False]
    assert VoronoiRouter.join(first, second).frozen.tolist() == [True, False, False, True, False]
    assert not router.part(torch.tensor([0])).frozen.any()


def test_diagrams_are_joined_at_the_root(torch_seed) -> None:
    one, _ = VoronoiDiagram(torch.rand(3, 3)).refine({0: torch.rand(2, 3), 2: torch.rand(4, 3)})
    two = VoronoiDiagram(torch.rand(2, 3) + 1)
    joined = VoronoiDiagram.join([one, two])
    assert joined.num_cells == one.num_cells + 2 and joined.depth == 2
    points = torch.rand(500, 3) * 2
    cells = joined.locate(points)
    mine = cells < one.num_cells
    assert torch.equal(cells[mine], one.locate(points)[mine]) and torch.equal(
        cells[~mine] - one.num_cells, two.locate(points)[~mine]
    )
    away = torch.cdist(points, torch.cat((one.centres[:3], two.centres)))
    assert torch.equal(away.argmin(1) < 3, mine)
    refuses("at least one, got none", lambda: VoronoiDiagram.join([]))
