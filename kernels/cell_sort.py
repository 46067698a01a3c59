"""Sorts samples by cell with Warp's radix sort, which is stable. n samples, k cells."""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch, on_stream
from voronerf.ops._core.checks import check_range
from voronerf.ops._core.declare import declared

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _keys_kernel(
    cells: wp.array(dtype=wp.int32), k: wp.int32, keys: wp.array(dtype=wp.int32), order: wp.array(dtype=wp.int32)
) -> None:
    i = wp.tid()
    # Cells out of range (possible if values are not checked) are sorted before cell 0, whose key is 1, or after the
    # last cell.
    keys[i] = wp.clamp(cells[i], -1, k) + 1
    order[i] = i


@wp.kernel
def _offsets_kernel(keys: wp.array(dtype=wp.int32), n: wp.int32, offsets: wp.array(dtype=wp.int32)) -> None:
    cell = wp.tid()
    # Find the first row whose sorted key is not below this cell's key.
    low = wp.int32(0)
    high = n
    while low < high:
        middle = low + (high - low) / 2
        if keys[middle] < cell + 1:
            low = middle + 1
        else:
            high = middle
    offsets[cell] = low


@declared("cell_sort").custom_op("cell_sort_warp")
def cell_sort(arguments: Any, results: tuple[Tensor, Tensor]) -> None:
    """Writes the stable order and the cell offsets; see ``voronerf.ops.cell_sort``."""
    cells, k, n = arguments.cells, arguments.k, arguments.n
    order, offsets = results
    check_range("cell_sort", "cells", cells, k)
    # Warp's sort needs memory for twice as many pairs, and leaves the result in the first half.
    keys, rows = cells.new_empty(2, 2 * n)
    launch(_keys_kernel, n, [array(cells, cells), k, array(keys, cells), array(rows, cells)], cells)
    with on_stream(cells):
        wp.utils.radix_sort_pairs(array(keys, cells), array(rows, cells), n, end_bit=max((k + 1).bit_length(), 1))
    launch(_offsets_kernel, k + 1, [array(keys, cells), n, array(offsets, cells)], cells)
    order.copy_(rows[:n])
