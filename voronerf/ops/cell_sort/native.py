"""``cell_sort`` of the compiled module. n samples, k cells."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.checks import check_range
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import rows_of

WAYS = native.compiled.CellSortWay
"""The sorting algorithms on CUDA; "automatic" chooses by the number of cells."""


def sort(cells: Tensor, order: Tensor, offsets: Tensor, caller: str, way: str = "automatic") -> None:
    """Fills the order and the offsets of cells.

    Args:
        cells: int32 [n], the cell of each sample.
        order: int32 [n], to be written.
        offsets: int32 [k + 1], to be written.
        caller: the name of the operation for error messages.
        way: the sorting algorithm on CUDA, one of ``WAYS``, for measurements.
    """
    compiled, machine = native.compiled, native.machine(cells)
    n, k = rows_of(cells), offsets.shape[0] - 1
    if isinstance(machine, compiled.Cuda):
        workspace = cells.new_empty(compiled.cell_sort_workspace(n, k, way, machine), dtype=torch.uint8)
        compiled.cell_sort(cells, order, offsets, workspace, n, k, way, machine)
        return
    if not compiled.cell_sort(cells, order, offsets, n, k, machine):
        check_range(caller, "cells", cells, k)


cell_sort = declared("cell_sort").compiled_op(
    "",
    "cell_sort",
    *("cells", "result0", "result1", "n", "k"),
    on_cuda=lambda arguments, found, _: sort(arguments.cells, found[0], found[1], "cell_sort"),
    fault=lambda arguments: check_range("cell_sort", "cells", arguments.cells, arguments.k),
)
