"""Every CUDA kernel on the CPU, through the public functions, against the reference.

Sizes are small: a block of 256 threads is 256 fibers.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from emulated import emulated

import voronerf
from voronerf import VoronoiDiagram


@pytest.fixture(params=(0, 1, 2), autouse=True)
def gpu(request: pytest.FixtureRequest) -> Iterator[None]:
    torch.manual_seed(request.param)
    with emulated(seed=request.param):
        yield


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(0, 3), (1, 1), (300, 17), (270, 700)])
def test_nearest_centre(n: int, k: int, dtype: torch.dtype) -> None:
    # Integers: many ties, which go to the lowest index.
    points = torch.randint(-3, 4, (n, 3)).to(dtype)
    centres = torch.randint(-3, 4, (k, 3)).to(dtype)
    for weights in (None, torch.randint(0, 3, (k,)).to(dtype)):
        found = voronerf.nearest_centre(points, centres, weights=weights, backend="native")
        expected = voronerf.nearest_centre(points, centres, weights=weights, backend="reference")
        assert torch.equal(found, expected)


def test_nearest_centre_of_points_that_are_no_numbers() -> None:
    points = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [1e30, 0, 0], [1, 1, 1]])
    centres = torch.tensor([[5.0, 0, 0], [1, 1, 1]])
    assert voronerf.nearest_centre(points, centres, backend="native").tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_locate_cell(dtype: torch.dtype) -> None:
    diagram = VoronoiDiagram(torch.rand(4, 3, dtype=dtype))
    diagram, _ = diagram.refine({1: torch.rand(3, 3, dtype=dtype), 3: torch.rand(2, 3, dtype=dtype)})
    points = torch.rand(300, 3, dtype=dtype)
    arguments = points, diagram.centres, diagram.child_offsets, diagram.child
    found = voronerf.locate_cell(*arguments, depth=diagram.depth, backend="native")
    assert torch.equal(found, voronerf.locate_cell(*arguments, depth=diagram.depth, backend="reference"))


@pytest.mark.parametrize(("n", "k"), [(0, 2), (1, 1), (33, 5), (5000, 3), (4200, 600), (2100, 1022), (2100, 1023)])
def test_cell_sort(n: int, k: int) -> None:
    cells = torch.randint(0, k, (n,), dtype=torch.int32)
    order, offsets = voronerf.cell_sort(cells, k, backend="native")
    expected = voronerf.cell_sort(cells, k, backend="reference")
    assert torch.equal(order, expected[0]) and torch.equal(offsets, expected[1])


def test_cell_sort_keeps_cells_that_are_none_at_the_ends() -> None:
    cells = torch.tensor([2, -1, 0, 3, 1, -5, 9], dtype=torch.int32)
    order, offsets = voronerf.cell_sort(cells, 3, backend="native")
    assert order.tolist() == [1, 5, 2, 4, 0, 3, 6]
    assert offsets.tolist() == [2, 3, 4, 5]
