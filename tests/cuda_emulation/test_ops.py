"""Tests of lookups and sorts on the emulated CUDA kernels, in several thread orders, against the reference.

Sizes are small: a block of 256 threads is 256 fibers. test_emulation.py runs the tests of the operations.
"""

import zlib

import pytest
import torch
from adam_steps import assert_adam
from emulated import emulated
from helpers import same

import voronerf
from voronerf import VoronoiDiagram
from voronerf.ops import index_centres
from voronerf.ops._core.layers import MLP, POSITIONS, Layer
from voronerf.ops.cell_sort.native import WAYS
from voronerf.ops.cell_sort.native import sort as sort_cells
from voronerf.ops.draw_pixels import native as draw_pixels
from voronerf.ops.draw_pixels import reference as draw_pixels_reference


@pytest.fixture(autouse=True)
def gpu(request):
    """Gives each case its own random numbers and thread order."""
    seed = zlib.crc32(request.node.name.encode())
    torch.manual_seed(seed)
    with emulated(seed=seed) as module:
        yield module


def both(op, *args, **options):
    return tuple(op(*args, backend=backend, **options) for backend in ("native", "reference"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_look_ups(dtype):
    for n, k in ((0, 3), (1, 1), (300, 17), (270, 700)):
        # Integers give many ties; the lowest index wins.
        points, centres = (torch.randint(-3, 4, (count, 3)).to(dtype) for count in (n, k))
        assert torch.equal(*both(voronerf.nearest_centre, points, centres))
        assert torch.equal(*both(voronerf.nearest_centre, points, centres, index=index_centres(centres)))
    odd = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [1e30, 0, 0], [1, 1, 1]], dtype=dtype)
    centres = torch.tensor([[5.0, 0, 0], [1, 1, 1]], dtype=dtype)
    for index in (None, index_centres(centres)):
        assert voronerf.nearest_centre(odd, centres, index=index, backend="native").tolist() == [0, 0, 0, 1]
    for d, k in ((1, 400), (2, 3), (4, 700)):
        points, centres = torch.rand(130, d, dtype=dtype), torch.rand(k, d, dtype=dtype)
        assert torch.equal(*both(voronerf.nearest_centre, points, centres))
        assert torch.equal(*both(voronerf.nearest_centre, points, centres, index=index_centres(centres)))
    diagram = VoronoiDiagram(torch.rand(4, 3, dtype=dtype))
    diagram, _ = diagram.refine({1: torch.rand(3, 3, dtype=dtype), 3: torch.rand(2, 3, dtype=dtype)})
    tables = diagram.centres, diagram.child_offsets, diagram.child
    assert torch.equal(*both(voronerf.locate_cell, torch.rand(300, 3, dtype=dtype), *tables, depth=diagram.depth))


SIZES = [(0, 2), (1, 1), (33, 5), (5000, 3), (4200, 600), (2100, 1022), (2100, 1023), (300, 65_534), (300, 65_535)]


def sorted_by(way, cells, k):
    """Sorts into poisoned memory."""
    order, offsets = torch.full_like(cells, -7), torch.full((k + 1,), -7, dtype=torch.int32)
    sort_cells(cells, order, offsets, "cell_sort", way)
    return order, offsets


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("n", "k"), SIZES)
def test_cell_sort(n, k, way):
    if way == "counting" and k > 1022:
        with pytest.raises(RuntimeError, match="cell_sort: too many cells for counting in shared memory"):
            sorted_by(way, torch.zeros(n, dtype=torch.int32), k)
        return
    cells = torch.randint(0, k, (n,), dtype=torch.int32)
    cells[::7] = k - 1
    found, expected = both(voronerf.cell_sort, cells, k)
    assert same(sorted_by(way, cells, k), expected) and same(found, expected)


@pytest.mark.parametrize("k", [3, 1022, 1023, 65_534, 65_535])
@pytest.mark.parametrize("way", ["automatic", "radix"])
def test_cell_sort_keeps_cells_that_are_none_at_the_ends(way, k):
    low, high = -(2**31), 2**31 - 1
    cells = torch.tensor([2, -1, 0, k, 1, low, high, k - 1, 65_536, -65_536, 1], dtype=torch.int32)
    order, offsets = sorted_by(way, cells, k)
    # One invalid cell would become valid if its key were cut to 16 bits.
    keys = cells.clamp(-1, k)
    assert torch.equal(order.long(), keys.sort(stable=True).indices)
    assert torch.equal(offsets, (keys[None] < torch.arange(k + 1)[:, None]).sum(1).int())


def test_draw_pixels():
    lengths = torch.randint(1, 9, (70,))
    runs = draw_pixels_reference.PixelRuns.of(torch.arange(70) * 10, lengths)
    known = draw_pixels_reference.KnownPixels(torch.randint(99, (20,)), torch.rand(20), 0)
    for below, given in ((10**10, None), (runs.total, runs)):
        for count in (0, 1, 300):
            arguments = torch.randint(-(2**31), 2**31, (1,), dtype=torch.int32), count, below, given
            arguments += (known._replace(draws=count // 2) if count > 1 else None,)
            expected = draw_pixels_reference.draw_pixels(*arguments)
            assert same(draw_pixels.draw_pixels(*arguments), expected)


@pytest.mark.parametrize("count", [1, 36, 83])
def test_adam_is_that_of_the_formula(count):
    other = {} if count == 36 else {"scale": torch.tensor(1024.0), "rate": torch.tensor(0.01)}
    assert_adam(count, backend="native", **other)


@pytest.mark.parametrize(("spoilt", "limit"), [("loss", torch.inf), (0, 1e18), (44, 1e3)])
def test_adam_leaves_out_a_step_that_is_not_finite(spoilt, limit):
    assert_adam(45, backend="native", spoilt=spoilt, limit=limit)


def test_tables_and_gradients_that_are_not_aligned():
    """Checks misaligned tables and gradients, which are copied because vector loads need multiples of 16 bytes."""
    grid, positions = voronerf.HashGrid(levels=2, features=4, log2_entries=10, finest=20), torch.rand(50, 3)
    table, gradient = torch.rand(grid.table_shape), torch.rand(50, 8)
    moved = [torch.cat([torch.zeros(1), x.flatten()])[1:].view(x.shape) for x in (table, gradient)]
    assert all(x.data_ptr() % 16 for x in moved)
    layers = MLP((Layer((POSITIONS,), 8),), (0,), position_encoding="hash", grid=grid)
    given = positions, torch.tensor([0, 50], dtype=torch.int32), [torch.rand(1, 8, 8)], [None]
    found = []
    for features, arriving in ((table, gradient), moved):
        leaf = features.detach().requires_grad_()
        for out in (
            voronerf.hash_encode(positions, leaf, grid, backend="native"),
            voronerf.grouped_mlp(*given, layers=layers, features=leaf, backend="native"),
        ):
            found += [out, *torch.autograd.grad(out, [leaf], arriving)]
    for one, other in zip(found[:4], found[4:], strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("op", ["hash_encode", "grouped_mlp"])
def test_atomic_sums_are_refused_where_deterministic_algorithms_are_asked_for(op):
    """Checks a table that is looked up directly, and inside a network."""
    grid = voronerf.HashGrid(levels=2, features=2, log2_entries=10, finest=20)
    table, positions = torch.rand(grid.table_shape, requires_grad=True), torch.rand(9, 3)
    if op == "hash_encode":
        total = voronerf.hash_encode(positions, table, grid, backend="native").sum()
    else:
        layers = MLP((Layer((POSITIONS,), 3),), (0,), position_encoding="hash", grid=grid)
        given = positions, torch.tensor([0, 9], dtype=torch.int32), [torch.rand(1, 3, 4)], [None]
        total = voronerf.grouped_mlp(*given, layers=layers, features=table, backend="native").sum()
    try:
        torch.use_deterministic_algorithms(True)
        with pytest.raises(RuntimeError, match=rf"^{op}: the gradient of a hash grid's table has no determ"):
            total.backward(retain_graph=True)
        torch.use_deterministic_algorithms(True, warn_only=True)
        with pytest.warns(UserWarning, match=rf"^{op}: the gradient"):
            total.backward()
    finally:
        torch.use_deterministic_algorithms(False)


def test_march_rays_adds_up_more_rays_than_a_block_has_threads(gpu):
    r, box = 2100, torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    directions = torch.nn.functional.normalize(torch.rand(r, 3) - 0.5, dim=1)
    rays = torch.rand(r, 3), directions, torch.zeros(r), torch.rand(r)
    given = *rays, torch.rand(3, 4, 5) < 0.5, box, 5
    for seed, capacity in enumerate((None, 1500, 20_000)):
        gpu.seed(seed)
        assert same(*both(voronerf.march_rays, *given, capacity=capacity))
