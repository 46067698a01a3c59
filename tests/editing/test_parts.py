"""Tests of parts: several routers in one scene, each in its own frame."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refuses

from voronerf import NeRF, OccupancyGrid, VoronoiDiagram, VoronoiRouter
from voronerf.app.train.config import TrainConfig
from voronerf.editing.geometry import Similarity, Solid
from voronerf.editing.network import StoredRouter
from voronerf.editing.parts import Part, Parts
from voronerf.nerf import Contraction
from voronerf.nerf.fields import HashGridField


@pytest.fixture
def torch_seed():
    torch.manual_seed(0)


def hashed(k: int, shift: float = 0.0, width: int = 8) -> VoronoiRouter:
    """Returns a router with different cells on one shared hash table."""
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


def part_of(router: VoronoiRouter, diagram: VoronoiDiagram | None = None, kept=None, voxels=None, **placed) -> Part:
    return Part(StoredRouter.of(router, TrainConfig(), voxels), diagram, kept, **placed)


def close(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool(torch.allclose(a, b, rtol=1e-4, atol=1e-5))


def test_one_part_gives_the_bits_of_its_router(torch_seed) -> None:
    router, inputs = hashed(5), queries()
    alone = router(*inputs)
    for parts in (Parts([part_of(router)]), Parts([part_of(router, region=[Solid.box((-9, -9, -9), (9, 9, 9))])])):
        result = parts.eval()(*inputs)
        assert torch.equal(result[0], alone[0]) and torch.equal(result[1], alone[1])
        assert torch.equal(parts.assign(inputs[0]), router.assign(inputs[0]))


def test_the_nearest_centre_of_all_parts_decides(torch_seed) -> None:
    one, two, inputs = hashed(4), plain(7, 1.0), queries()
    parts = Parts([part_of(one), part_of(two)]).eval()
    nearest = torch.cdist(inputs[0], torch.cat([one.diagram.centres, two.diagram.centres])).argmin(1)
    assert torch.equal(parts.assign(inputs[0]).long(), nearest)
    colour, density = parts(*inputs)
    first = nearest < 4
    assert 0 < int(first.sum()) < len(first)
    for mask, (c, d) in ((first, one(*inputs)), (~first, two(*inputs))):
        assert close(colour[mask], c[mask]) and close(density[mask], d[mask])


@pytest.mark.parametrize("n", [0, 1])
def test_few_points(torch_seed, n: int) -> None:
    parts = Parts([part_of(hashed(2)), part_of(plain(3, 1.0), region=[Solid(ball=(1, 0, 0, 0.1))])]).eval()
    points, directions, index = queries(n)
    colour, density = parts(points, directions, index)
    assert colour.shape == (n, 3) and density.shape == (n,) and parts.assign(points).shape == (n,)


def test_nothing_speaks_for_a_point(torch_seed) -> None:
    parts = Parts([part_of(hashed(2), region=[Solid.box((5, 5, 5), (6, 6, 6))])]).eval()
    points, directions, index = queries()
    colour, density = parts(points, directions, index)
    assert not colour.any() and not density.any() and (parts.assign(points) == -1).all()


def test_a_similarity_moves_points_directions_and_densities(torch_seed) -> None:
    router, (points, directions, index) = plain(5), queries()
    frame = Similarity.of((1, -2, 3), (10, 20, 30), 2.5)
    parts = Parts([part_of(router, frame=frame)]).eval()
    colour, density = parts(frame.points(points), frame.directions(directions), index)
    wanted = router(points, directions, index)
    assert close(colour, wanted[0]) and close(density * 2.5, wanted[1])


def test_voxels_that_were_empty_in_the_training_are_empty(torch_seed) -> None:
    router, (points, directions, index) = plain(5), queries()
    sphere, frame = Contraction(torch.tensor([1.0, 0.5, 0.5]), 0.4), Similarity.of((1, -2, 3), (10, 20, 30), 2.5)
    grid = OccupancyGrid(sphere.cube, 3, threshold=1.0)
    grid.occupied[1] = False
    parts = Parts([part_of(router, voxels=(grid.box, grid.occupied), frame=frame, contraction=sphere)]).eval()
    density = parts(frame.points(points), frame.directions(directions), index)[1]
    contracted = sphere.points(points)
    full = grid.occupied.view(-1)[grid.voxels(contracted).long()]
    assert 0 < int(full.sum()) < len(full)
    assert close(density * 2.5, router(contracted, directions, index)[1] * full)
    kept = parts[0].keep(torch.tensor([0, 2]))  # a cut, stored and read again
    assert all(map(torch.equal, StoredRouter(kept.network.stored()).voxels, (grid.box, grid.occupied)))


def test_similarities(torch_seed) -> None:
    frame = Similarity.of((1, -2, 3), (10, 20, 30), 2.5)
    points = torch.randn(10, 3, dtype=torch.float64)
    assert torch.allclose(frame.inverse.points(frame.points(points)), points)
    other = Similarity.of((0, 1, 0), (0, 90, 0))
    assert torch.allclose((frame @ other).points(points), frame.points(other.points(points)))
    assert torch.allclose(other.points(torch.tensor([[0.0, 0, 1]])), torch.tensor([[1.0, 1, 0]]), atol=1e-6)
    mirror = torch.diag(torch.tensor([1.0, 1, -1]))
    for scale in (0.0, -1.0, 1e30, float("nan")):
        refuses(f"scale must lie in 1e-9..1e9, got {scale}", Similarity, scale)
    refuses("must not mirror", lambda: Similarity(1.0, mirror))
    refuses("must be orthonormal", lambda: Similarity(1.0, 2 * torch.eye(3)))
    refuses("translation must be [3] finite", lambda: Similarity(translation=torch.tensor([0, math.nan, 0])))


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


def test_cells_that_are_cut_away_show_nothing_and_leave_the_others(torch_seed) -> None:
    router, inputs = hashed(6), queries(width=1.0)
    part, nothing = (part_of(router).keep(torch.tensor(cells, dtype=torch.int64)) for cells in ([1, 4], []))
    assert part.num_cells == part.network.router.num_cells == 2 and nothing is None
    colour, density = Parts([part]).eval()(*inputs)
    cells, wanted = router.assign(inputs[0]), router(*inputs)
    kept = (cells == 1) | (cells == 4)
    assert torch.equal(colour[kept], wanted[0][kept]) and torch.equal(density[kept], wanted[1][kept])
    assert not density[~kept].any()
    assert part.keep(torch.tensor([1])).kept.tolist() == [False, False, False, False, True, False]


def test_a_hole_goes_to_the_nearest_part_that_speaks(torch_seed) -> None:
    one, two, inputs = hashed(6), plain(3), queries(width=1.0)
    hole = part_of(one).keep(torch.tensor([0, 1, 2, 3]))
    parts = Parts([hole, part_of(two)]).eval()
    cells = one.assign(inputs[0])
    nearest = torch.cdist(inputs[0], torch.cat([one.diagram.centres[:4], two.diagram.centres])).argmin(1)
    assert torch.equal(parts.assign(inputs[0]) < 4, (nearest < 4) & (cells < 4))
    gone = cells > 3
    assert gone.any()
    assert close(parts(*inputs)[1][gone], two(*inputs)[1][gone])


def test_layers_add_up(torch_seed) -> None:
    under, above, inputs = hashed(3), plain(2), queries(width=1.0)
    ball = Solid(ball=(0.5, 0.5, 0.5, 0.4))
    colour, density = Parts([part_of(under), part_of(above, layer=1, region=[ball])]).eval()(*inputs)
    (c0, d0), (c1, d1), inside = under(*inputs), above(*inputs), ball.holds(inputs[0])
    assert torch.equal(colour[~inside], c0[~inside]) and torch.equal(density[~inside], d0[~inside])
    assert close(density[inside], (d0 + d1)[inside])
    mixed = (c0 * d0[:, None] + c1 * d1[:, None]) / (d0 + d1)[:, None]
    assert close(colour[inside], mixed[inside])


def test_a_contracted_part_is_asked_in_its_own_space(torch_seed) -> None:
    router, contraction = plain(4), Contraction(torch.zeros(3), 1.0)
    parts = Parts([part_of(router, contraction=contraction)]).eval()
    points, directions, index = queries(width=5.0)
    assert close(parts(points, directions, index)[1], router(contraction.points(points), directions, index)[1])


def test_what_a_part_refuses(torch_seed) -> None:
    refuses("kept must have shape [3]", lambda: part_of(plain(3), kept=torch.zeros(2)))
    refuses("kept must mark as many leaves", lambda: part_of(plain(3), VoronoiDiagram(torch.rand(4, 3))))
    refuses("at least one in layer 0", lambda: Parts([part_of(plain(1), layer=1)]))
