from __future__ import annotations

from bisect import bisect_left

import pytest
import torch
from op_cases import refusals

from voronerf.ops import cell_sort

pytestmark = pytest.mark.op("cell_sort")


def check(cells, k, order, offsets):
    keys = cells.tolist()
    assert order.dtype == offsets.dtype == torch.int32
    assert order.tolist() == sorted(range(len(keys)), key=keys.__getitem__)
    keys.sort()
    assert offsets.tolist() == [bisect_left(keys, cell) for cell in range(k + 1)]


@pytest.mark.parametrize(("n", "k"), [*((333, k) for k in (1, 2, 7, 255, 256, 257, 40000)), (0, 1), (1, 7), (2, 40000)])
def test_is_the_stable_sort(device, backend, n, k):
    cells = torch.randint(0, k, (n,), dtype=torch.int32)
    check(cells, k, *(part.cpu() for part in cell_sort(cells.to(device), k, backend=backend)))


def test_compiled_reference_keeps_stray_cells_apart():
    cells = torch.tensor([3, 9, 0, -5, 2, 3], dtype=torch.int32)
    compiled = torch.compile(
        lambda cells: cell_sort(cells, 4, backend="reference"), fullgraph=True, backend="aot_eager"
    )
    order, offsets = compiled(cells)
    assert order.tolist() == [3, 2, 4, 0, 5, 1]
    assert offsets.tolist() == [1, 2, 2, 3, 5]


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_errors(backend):
    cells = torch.tensor([0, 3, 1], dtype=torch.int32)
    refuses = refusals(cell_sort, cells=cells, k=4, backend=backend)
    refuses("cells must lie in 0 to 2, got values from 0 to 3", k=3)
    refuses("cells must lie in 0 to 3, got values from -2 to 1", cells=cells - 2)
