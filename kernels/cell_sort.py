"""Sorting samples by cell with Warp's radix sort, which is stable. n samples, k cells."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch, on_stream

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _keys_kernel(
    cells: wp.array(dtype=wp.int32),
    k: wp.int32,
    keys: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    # Cells out of range (possible where values are not read) go before cell 0, whose key is 1, or behind the last.
    keys[i] = wp.clamp(cells[i], -1, k) + 1
    order[i] = i


@wp.kernel
def _offsets_kernel(keys: wp.array(dtype=wp.int32), n: wp.int32, offsets: wp.array(dtype=wp.int32)) -> None:
    cell = wp.tid()
    # First row of the sorted keys that is not below this cell's.
    low = wp.int32(0)
    high = n
    while low < high:
        middle = low + (high - low) / 2
        if keys[middle] < cell + 1:
            low = middle + 1
        else:
            high = middle
    offsets[cell] = low


def cell_sort(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Stable order and cell offsets; see ``voronerf.ops.cell_sort``."""
    order, offsets = _cell_sort(cells, k)
    return order, offsets


@torch.library.custom_op("voronerf::cell_sort_warp", mutates_args=())
def _cell_sort(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    n = cells.shape[0]
    if not cells.is_cuda and n > 0:
        low, high = (int(bound) for bound in cells.aminmax())
        if low < 0 or high >= k:
            raise ValueError(f"cell_sort: cells must lie in 0 to {k - 1}, got values from {low} to {high}")
    # The sort needs room for twice the pairs, and leaves them in the first half.
    keys, order = cells.new_empty(2 * n), cells.new_empty(2 * n)
    offsets = cells.new_empty(k + 1)
    launch(_keys_kernel, n, [array(cells, cells), k, array(keys, cells), array(order, cells)], cells)
    with on_stream(cells):
        wp.utils.radix_sort_pairs(array(keys, cells), array(order, cells), n, end_bit=max((k + 1).bit_length(), 1))
    launch(_offsets_kernel, k + 1, [array(keys, cells), n, array(offsets, cells)], cells)
    return order[:n].clone(), offsets


@_cell_sort.register_fake
def _(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    return torch.empty_like(cells), cells.new_empty(k + 1)
