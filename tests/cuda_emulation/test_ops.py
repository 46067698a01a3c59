"""Look-ups and sorts by the CUDA kernels on the CPU, with threads in three orders, against the reference.

Sizes are small: a block of 256 threads is 256 fibers. The tests of the operations themselves run in test_emulation.py.
"""

import pytest
import torch
from emulated import emulated
from helpers import same

import voronerf
from voronerf import VoronoiDiagram
from voronerf.ops.cell_sort.native import WAYS
from voronerf.ops.cell_sort.native import sort as sort_cells


@pytest.fixture(params=(0, 1, 2), autouse=True)
def gpu(request):
    torch.manual_seed(request.param)
    with emulated(seed=request.param):
        yield


def both(op, *args, **options):
    return tuple(op(*args, backend=backend, **options) for backend in ("native", "reference"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_look_ups(dtype):
    for n, k in ((0, 3), (1, 1), (300, 17), (270, 700)):
        # Integers: many ties, which go to the lowest index.
        points, centres = (torch.randint(-3, 4, (count, 3)).to(dtype) for count in (n, k))
        for weights in (None, torch.randint(0, 3, (k,)).to(dtype)):
            assert torch.equal(*both(voronerf.nearest_centre, points, centres, weights=weights))
    odd = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [1e30, 0, 0], [1, 1, 1]], dtype=dtype)
    centres = torch.tensor([[5.0, 0, 0], [1, 1, 1]], dtype=dtype)
    assert voronerf.nearest_centre(odd, centres, backend="native").tolist() == [0, 0, 0, 1]
    diagram = VoronoiDiagram(torch.rand(4, 3, dtype=dtype))
    diagram, _ = diagram.refine({1: torch.rand(3, 3, dtype=dtype), 3: torch.rand(2, 3, dtype=dtype)})
    tables = diagram.centres, diagram.child_offsets, diagram.child
    assert torch.equal(*both(voronerf.locate_cell, torch.rand(300, 3, dtype=dtype), *tables, depth=diagram.depth))


@pytest.mark.parametrize("weighted", [False, True])
def test_draw_cell(weighted):
    def of(k):
        return VoronoiDiagram(torch.rand(k, 3), weights=torch.rand(k) / 4 if weighted else None)

    diagram, _ = of(4).refine({1: of(3), 3: of(3)})
    points, uniforms = torch.rand(300, 3), torch.rand(300, 2)
    points[7], uniforms[8] = torch.nan, torch.nan
    arguments = points, diagram.centres, diagram.child_offsets, diagram.child, uniforms
    found, expected = both(voronerf.draw_cell, *arguments, temperature=0.2, depth=2, weights=diagram.power)
    # numbers within rounding of a border, of which there is one in 10,000
    assert int((found != expected).sum()) <= 1 and found[7] == 0


def test_draw_cell_stays_inside_unsound_tables():
    points, centres = torch.rand(50, 3), torch.rand(3, 3)
    for offsets, child, depth in (
        ([0, 3], [5, 1_000_000_000, 9], 3),  # no such diagram
        ([0, 2_000_000_000], [-1, -2, -3], 1),  # more centres than there are
        ([0, 0, 3], [1, 1, 1], 2),  # a diagram without centres
        ([0, 1, 3], [1, 1, 0], 4),  # a walk that ends at no leaf
    ):
        tables = (torch.tensor(table, dtype=torch.int32) for table in (offsets, child))
        uniforms = torch.rand(50, depth)
        leaves = voronerf.draw_cell(points, centres, *tables, uniforms, temperature=0.1, depth=depth, backend="native")
        assert bool((leaves < 0).all())


SIZES = [(0, 2), (1, 1), (33, 5), (5000, 3), (4200, 600), (2100, 1022), (2100, 1023), (300, 65_534), (300, 65_535)]


def sorted_by(way, cells, k):
    """Into memory that is poisoned."""
    order, offsets = torch.full_like(cells, -7), torch.full((k + 1,), -7, dtype=torch.int32)
    sort_cells(cells, order, offsets, "cell_sort", way)
    return order, offsets


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("n", "k"), SIZES)
def test_cell_sort(n, k, way):
    if way == "counting" and k > 1022:
        with pytest.raises(RuntimeError, match="cell_sort: too many cells to be counted in shared memory"):
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
    # A stray among the others is one that a key cut to 16 bits would put into a cell.
    keys = cells.clamp(-1, k)
    assert torch.equal(order.long(), keys.sort(stable=True).indices)
    assert torch.equal(offsets, (keys[None] < torch.arange(k + 1)[:, None]).sum(1).int())
