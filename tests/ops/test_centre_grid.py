"""The centre grid finds, to the last index, what a search of all centres finds."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import pytest
import torch
from helpers import on_any_number_of_threads, refuses, same
from op_cases import refusals
from torch import Tensor

from voronerf.diagram import VoronoiDiagram, uniform_centres
from voronerf.ops import CentreGrid, centre_grid, nearest_centre
from voronerf.ops._core import backends

native = pytest.mark.native
BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


def clustered(k):
    return torch.cat([2 * torch.rand(k // 4, 3) - 1, 0.3 + 1e-3 * torch.rand(k - k // 4, 3)])


def shell(k):
    centres = torch.randn(k, 3)
    return centres / centres.norm(dim=1, keepdim=True) + 0.02 * torch.randn(k, 3)


def flat(k):
    return torch.cat([torch.rand(k, 2), torch.full((k, 1), 0.25)], dim=1)


def in_line(k):
    return torch.linspace(-1, 1, k)[:, None] * torch.tensor([1.0, 2, 0.5])


SCENES: dict[str, Callable[[], Tensor]] = {
    "one": lambda: torch.rand(1, 3),
    "two": lambda: torch.rand(2, 3),
    "random": lambda: 2 * torch.rand(130, 3) - 1,
    "lattice": lambda: torch.randint(-3, 4, (400, 3)).float(),
    "kilonerf": lambda: uniform_centres(BOX, 512),
    "clustered": lambda: clustered(120),
    "shell": lambda: shell(300),
    "flat": lambda: flat(200),
    "in line": lambda: in_line(100),
    "all the same": lambda: torch.full((100, 3), 0.7),
    "shifted": lambda: torch.rand(100, 3) + 1000.0,
    "tiny": lambda: 1e-30 * torch.rand(100, 3),
    "at the end of the range": lambda: 3e38 * (2 * torch.rand(50, 3) - 1),
    "unequal axes": lambda: torch.rand(200, 3) * torch.tensor([1.0, 1e-3, 1e3]),
}


def points_around(centres):
    """Among the centres, on them, half way between two, far out along axes and diagonals, and no points at all."""
    k = len(centres)
    low, high = centres.amin(0), centres.amax(0)
    size = torch.maximum((high / 2 - low / 2).max(), 1e-6 * centres.abs().max()).clamp(min=1e-37)
    middle = low / 2 + high / 2
    pairs = torch.randint(k, (2, 300))
    near = [middle + scale * size * (2 * torch.rand(400, 3) - 1) for scale in (1, 3, 30)]
    away = torch.randint(-1, 2, (200, 3)) * size * 10 ** (6 * torch.rand(200, 1))
    odd = torch.tensor([[torch.nan, 0, 0], [0, torch.inf, 0], [-torch.inf, torch.nan, 1], [3e38, 3e38, -3e38]])
    between = centres[pairs[0]] / 2 + centres[pairs[1]] / 2
    return torch.cat([*near, centres[pairs[0]], between, middle + away, odd]).to(centres.dtype)


@pytest.mark.op("nearest_centre_grid")
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_finds_what_all_centres_give(backend, scene, dtype):
    if backend == "reference" and (dtype == torch.float32 or scene in ("kilonerf", "lattice", "shell")):
        pytest.skip("slow, and the same code for all centres and types")
    centres = SCENES[scene]().to(dtype)
    points = points_around(centres)
    found = nearest_centre(points, centres, grid=centre_grid(centres, backend=backend), backend=backend)
    assert found.dtype == torch.int32
    assert torch.equal(found, nearest_centre(points, centres, backend="reference"))


@native
@pytest.mark.parametrize("k", [512, 4096])
def test_ties_of_a_regular_grid(k):
    """On the faces, edges and corners of equal cubes, where up to eight centres are equally near."""
    side = round(k ** (1 / 3))
    steps = torch.arange(side).float()
    centres = torch.cartesian_prod(steps, steps, steps) + 0.5
    grid = centre_grid(centres)
    points = torch.randint(-2, 2 * side + 3, (20_000, 3)).float() / 2
    found = nearest_centre(points, centres, grid=grid)
    assert torch.equal(found, nearest_centre(points, centres, backend="native"))
    inside = ((points > 0) & (points < side)).all(1)
    lowest = (points[inside].ceil() - 1).long()
    assert torch.equal(found[inside].long(), (lowest * torch.tensor([side * side, side, 1])).sum(1))


@native
def test_instruction_sets_and_threads_build_the_same_grid(isa):
    from voronerf.ops._core import native

    centres = clustered(700)
    points = points_around(centres)[:-1].repeat(3, 1)
    with native.using_isa(native.SUPPORTED_ISAS[-1]):
        expected = centre_grid(centres)
    cells = nearest_centre(points, centres, backend="reference")
    sizes = (0, 1, 15, 17, len(points))

    def run():
        grid = centre_grid(centres)
        return [
            *grid.tables[:4],
            *(nearest_centre(points[:n], centres, grid=grid) for n in sizes),
        ]

    assert same(on_any_number_of_threads(run), [*expected.tables[:4], *(cells[:n] for n in sizes)])


@native
@pytest.mark.parametrize("scene", ["random", "clustered", "flat"])
def test_lists_hold_every_centre_that_is_nearest_somewhere(scene):
    """The tables of one backend serve the other, and those of the kernel are shorter."""
    centres = SCENES[scene]()
    points = points_around(centres)
    own, plain = centre_grid(centres, backend="native"), centre_grid(centres, backend="reference")
    expected = nearest_centre(points, centres, backend="reference")
    swapped = CentreGrid(centres, plain.tables)
    assert torch.equal(nearest_centre(points, centres, grid=swapped, backend="native"), expected)
    assert torch.equal(nearest_centre(points, centres, grid=own, backend="reference"), expected)
    assert mean_length(own.tables) <= mean_length(plain.tables)


def mean_length(tables):
    """Of the lists of the root grid, bricks of 4^3 cells averaged."""
    entries, lists = tables.entries.long(), tables.lists

    def length(entry):
        if entry >= 0:
            return float(lists[entry])
        return sum(length(int(entries[~entry + i])) for i in range(64)) / 64

    rows = entries[: 8**tables.bits : 37]
    return sum(length(int(entry)) for entry in rows) / len(rows)


@native
@pytest.mark.parametrize("scale", [1.0, 1e160])
def test_memory_is_bounded_where_no_centre_can_be_left_out(scale):
    """All centres are candidates around the middle of a sphere, and everywhere where their squares overflow."""
    centres = torch.randn(300, 3, dtype=torch.float64)
    centres /= centres.norm(dim=1, keepdim=True)
    points = torch.cat([centres, 1e-3 * torch.randn(50, 3, dtype=torch.float64)]) * scale
    grid = centre_grid(centres * scale)
    assert grid.nbytes < 10e6
    expected = nearest_centre(points, centres * scale, backend="reference")
    assert torch.equal(nearest_centre(points, centres * scale, grid=grid), expected)


def test_errors():
    points, centres = torch.rand(4, 3), torch.rand(5, 3)
    refuses = refusals(nearest_centre, points=points, centres=centres, grid=centre_grid(centres))
    for others in (centres + 1, centres[:4]):
        refuses("grid must be made from these centres, got that of others", centres=others)
    refuses("grid must be a CentreGrid, got Tensor", grid=centres)
    refuses = refusals(centre_grid, centres=centres)
    refuses("centres must hold at least one centre, got none", centres=centres[:0])
    refuses("centres must be finite, got NaN or infinity", centres=torch.full((2, 3), torch.inf))


def write(tensor, at, value):
    changed = tensor.clone()
    changed[at] = value
    return changed


@native
def test_forged_grids():
    """They crashed, or their search never ended, where a query trusted them."""
    torch.manual_seed(0)
    centres = clustered(120)
    grid = centre_grid(centres)
    tables, pickled = grid.tables, pickle.dumps(grid)
    cell = int((tables.entries >= 0).nonzero()[0])
    root, place = 8**tables.bits, int(tables.entries[cell])
    brick = -1 - int(tables.entries[:root].min())
    assert brick >= root, "has no brick"
    cases = [
        ("tables.entries must name the start of a brick", {"entries": write(tables.entries, cell, -2)}),
        ("tables.entries must name the start of a brick", {"entries": write(tables.entries, cell, -(2**31))}),
        ("tables.entries must name each brick once", {"entries": write(tables.entries, brick, -1 - brick)}),
        ("tables.entries must name each brick once", {"entries": write(tables.entries, slice(root), -1 - brick)}),
        ("tables.entries must be 4096 and bricks", {"entries": tables.entries[:-1]}),
        ("tables.entries must have dtype int32", {"entries": tables.entries.long()}),
        ("tables.lists must have a list", {"entries": write(tables.entries, cell, 2**31 - 1)}),
        ("tables.lists must have a list", {"lists": tables.lists[:place]}),
        *(("tables.lists must have a list", {"lists": write(tables.lists, place, n)}) for n in (0, -3, 2**31 - 1)),
        *(("tables.lists must hold centres", {"lists": write(tables.lists, place + 1, n)}) for n in (-1, 120, 2**30)),
        ("tables.table must have shape [k, 4] with k = 120", {"table": tables.table[:-1]}),
        ("tables.table must hold the centres", {"table": tables.table + 1}),
        ("tables.bits must be 4 for 120 centres, got 12", {"bits": 12}),
        ("tables.frame must have shape [2, 3]", {"frame": tables.frame[:1]}),
    ]
    for message, changed in cases:
        forged = pickle.loads(pickled)
        object.__setattr__(forged, "tables", tables._replace(**changed))
        kinds = (ValueError, TypeError)
        refuses(f"CentreGrid: {message}", CentreGrid, centres, forged.tables, error=kinds)
        refuses(f"CentreGrid: {message}", pickle.loads, pickle.dumps(forged), error=kinds)
    copy = pickle.loads(pickled)
    points = points_around(centres)
    assert torch.equal(nearest_centre(points, centres, grid=copy), nearest_centre(points, centres))


@native
def test_grid_keeps_its_own_centres():
    centres, points = torch.rand(50, 3), torch.rand(100, 3)
    grid = centre_grid(centres)
    half = centres.half()
    assert torch.equal(
        nearest_centre(points, half, grid=centre_grid(half)), nearest_centre(points, half, backend="reference")
    )
    assert torch.equal(nearest_centre(points.double(), centres, grid=grid), nearest_centre(points.double(), centres))
    centres += 1
    with pytest.raises(ValueError, match="grid must be made from these centres"):
        nearest_centre(points, centres, grid=grid)


@native
def test_a_grid_is_not_that_of_rounded_centres():
    centres = torch.rand(100, 3, dtype=torch.float64) + 1e6
    points, of_others = torch.rand(50, 3) + 1e6, "grid must be made from these centres"
    with pytest.raises(ValueError, match=of_others):
        nearest_centre(points, centres.float(), grid=centre_grid(centres))
    exact = centres.float().double()
    found = nearest_centre(points, exact.float(), grid=centre_grid(exact))
    assert torch.equal(found, nearest_centre(points, exact.float(), backend="reference"))


@native
def test_compiled_graphs_refuse_grids_of_another_size():
    # Such a grid names centres behind the end of those that are given.
    points, grid = torch.rand(5, 3), centre_grid(torch.rand(70, 3))
    compiled = torch.compile(lambda p, c: nearest_centre(p, c, grid=grid), fullgraph=True, backend="eager")
    with pytest.raises(Exception, match="grid must be made from these centres"):
        compiled(points, torch.rand(2, 3))


@native
def test_the_custom_op_passes_opcheck():
    centre_grid(torch.rand(70, 3))  # which registers it
    torch.library.opcheck(torch.ops.voronerf.centre_grid.default, (torch.rand(70, 3).double(),))


@native
def test_diagrams_make_a_grid_where_it_pays(monkeypatch):
    monkeypatch.setattr("voronerf.diagram.voronoi._GRID_POINTS", 1500)
    points = 4 * torch.rand(1000, 3) - 2
    diagram = VoronoiDiagram(2 * torch.rand(512, 3) - 1)
    expected = diagram.locate(points, backend="reference")
    assert torch.equal(diagram.locate(points), expected) and diagram._grid is None
    for dtype in (torch.float32, torch.float64):
        assert torch.equal(diagram.locate(points.to(dtype)), diagram.locate(points.to(dtype), backend="reference"))
    assert diagram._grid is not None
    kept = diagram._grid
    diagram.locate(points)
    assert diagram._grid is kept
    # Whoever writes to the buffers gets the cells of what is written.
    with torch.no_grad():
        diagram.centres.copy_(diagram.centres.flip(0))
    assert torch.equal(diagram.locate(points), diagram.locate(points, backend="reference"))
    assert "_grid" not in diagram.__getstate__()
    small = VoronoiDiagram(torch.rand(64, 3))
    for _ in range(3):
        small.locate(points)
    assert small._grid is None


def test_backends_list_the_grid():
    assert {"centre_grid", "nearest_centre_grid"} <= set(backends.ops())
