"""Diagrams and routers of 1 to 4 coordinates."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor, nn

from voronerf import VoronoiDiagram, balance, split_diagram
from voronerf.router import VoronoiRouter

DIMENSIONS = [1, 2, 3, 4]


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(8)


def nearest(points: Tensor, centres: Tensor) -> Tensor:
    return (points[:, None].double() - centres.double()).square().sum(-1).argmin(1)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_many_cells_have_an_index(d: int, generator: torch.Generator) -> None:
    diagram = VoronoiDiagram(torch.rand(2500, d, generator=generator))
    points = torch.rand(200, d, generator=generator)

    def is_right(one: VoronoiDiagram) -> bool:
        return torch.equal(one.locate(points).long(), nearest(points, one.centres))

    assert is_right(diagram)
    index = diagram.index()
    assert diagram.index() is index  # the index is cached
    assert is_right(copy.deepcopy(diagram)) and is_right(pickle.loads(pickle.dumps(diagram)))
    diagram.centres.neg_()  # an in-place change outdates the index
    assert is_right(diagram)
    diagram.centres.data.copy_(torch.rand(2500, d, generator=generator))  # the version counter stays
    assert is_right(diagram)
    assert torch.equal(diagram.locate(points.double()), diagram.locate(points))
    if d == 3:
        compiled = torch.compile(diagram.locate, fullgraph=True, backend="eager")
        assert torch.equal(compiled(points), diagram.locate(points))
    assert diagram.to("meta").locate(points.to("meta")).shape == (200,)
    diagram = VoronoiDiagram(torch.rand(2500, d, generator=generator))
    other = VoronoiDiagram(torch.rand(3000, d, generator=generator))
    diagram.load_state_dict(other.state_dict())
    assert is_right(diagram) and torch.equal(diagram.locate(points), other.locate(points))
    assert VoronoiDiagram(other.centres[:100]).index() is None


@pytest.mark.parametrize("d", DIMENSIONS)
def test_refine_split_draw_save_and_part(d: int, generator: torch.Generator) -> None:
    points, importance = torch.rand(3000, d, generator=generator), torch.rand(3000, generator=generator)
    for centres in ("balanced", "centroidal", "random", "uniform"):
        result = balance(points, importance, 6, centres=centres, generator=generator)
        assert result.centres.shape == (6, d)
        weights = torch.zeros(6).double().index_add(0, nearest(points, result.centres), importance.double())
        torch.testing.assert_close(result.after, weights)
        assert centres != "balanced" or result.imbalance_after < result.imbalance_before
    flat = VoronoiDiagram.from_points(points, 6, importance, generator=generator)
    nested = split_diagram(flat, points, importance, 4, generator=generator).diagram
    assert (nested.num_cells, nested.depth) == (24, 2)
    cells = nested.locate(points).long()
    assert torch.equal(nested.paths()[cells, 0], flat.locate(points).long())
    for outer in range(6):
        inside = (nested.paths()[:, 0] == outer).nonzero()[:, 0]
        own = flat.locate(points) == outer
        assert torch.equal(cells[own], inside[nearest(points[own], nested.leaf_centres[inside])])
    assert torch.equal(nested.sample_cell(points, temperature=1e-9, generator=generator).long(), cells)
    assert torch.equal(VoronoiDiagram.from_state(nested.state_dict()).locate(points).long(), cells)
    part = nested.part(torch.tensor([3, 20]))
    assert bool((part.locate(points[cells == 20]) == 1).all())


def test_from_points_draws_of_many_and_takes_any_shape(generator: torch.Generator) -> None:
    points = torch.rand(100, 400, 2, generator=generator)
    diagram = VoronoiDiagram.from_points(points, 16, generator=generator)
    shares = torch.bincount(diagram.locate(points).flatten(), minlength=16) / 40_000
    assert 0.3 / 16 < shares.min() < shares.max() < 3 / 16
    left = (points[..., 0] < 0.1).float()
    assert VoronoiDiagram.from_points(points, 4, left, generator=generator).centres[:, 0].max() < 0.1


def test_points_that_float32_cannot_tell_apart_are_one_point(generator: torch.Generator) -> None:
    """The draw of many points has one point in float32, so that all points are needed."""
    near = 0.5 + 1e-13 * torch.arange(30_000, dtype=torch.float64)[:, None].expand(-1, 3)
    diagram = VoronoiDiagram.from_points(torch.cat((near, torch.eye(3).double())), 4, generator=generator)
    assert diagram.num_cells == 4


def test_from_points_takes_as_many_cells_as_distinct_points(generator: torch.Generator) -> None:
    points = torch.rand(120_000, 3, generator=generator)
    diagram = VoronoiDiagram.from_points(points, 25_000, centres="random", generator=generator)
    assert diagram.centres.unique(dim=0).shape == (25_000, 3)
    rare = torch.zeros(50_000, 2)
    rare[:3] = torch.rand(3, 2, generator=generator) + 1
    result = VoronoiDiagram.from_points(rare, 4, generator=generator).centres
    assert torch.equal(result.unique(dim=0), rare[:4].unique(dim=0))
    with pytest.raises(ValueError, match="k must be at most the number of distinct points, 4, got 5"):
        VoronoiDiagram.from_points(rare, 5, generator=generator)


@pytest.mark.parametrize("d", DIMENSIONS)
@pytest.mark.parametrize("options", [{"way": "loop"}, {"way": "grouped"}, {"fuse": True}])
def test_a_router_of_so_many_coordinates(d: int, options: dict[str, object], generator: torch.Generator) -> None:
    net = nn.Sequential(nn.Linear(d, 16), nn.ReLU(), nn.Linear(16, 3))
    points = torch.rand(30, 20, d, generator=generator)
    router = VoronoiRouter(net, VoronoiDiagram.from_points(points, 5), coords=f"first{d}", **options)  # type: ignore[arg-type]
    with torch.no_grad():
        for parameter in router.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    cells, modules = nearest(points.reshape(-1, d), router.diagram.centres), [router.cell(i) for i in range(5)]
    expected = torch.stack([modules[c](x) for c, x in zip(cells.tolist(), points.reshape(-1, d))])
    torch.testing.assert_close(router(points), expected.reshape(30, 20, 3))
    torch.testing.assert_close(router(points, coords=points.clone()), router(points))
    optimizer = torch.optim.Adam(router.parameters())
    router(points).square().mean().backward()
    optimizer.step()
    router.subdivide(2, optimizer=optimizer, points=points.reshape(-1, d), weights=torch.ones(600))
    assert router.num_cells == 10
    router(points).square().mean().backward()
    again = VoronoiRouter(net, torch.zeros(1, d), coords=f"first{d}", **options)  # type: ignore[arg-type]
    again.load_state_dict(router.state_dict())
    torch.testing.assert_close(again(points), router(points))
