"""Updating an occupancy grid as Warp kernels. n cells, q of them updated."""

from __future__ import annotations

from collections.abc import Iterator

import torch
import warp as wp
from torch import Tensor

from voronerf.checks import check_range
from voronerf.custom_op import custom_op
from voronerf.kernels._launch import array, launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _fade_kernel(
    density: wp.array(dtype=wp.float32),
    cells: wp.array(dtype=wp.int32),
    decay: wp.float32,
    result: wp.array(dtype=wp.float32),
) -> None:
    i = wp.tid()
    # From the old density: a cell that occurs twice decays once, in any order.
    result[cells[i]] = density[cells[i]] * decay


@wp.kernel
def _raise_kernel(
    cells: wp.array(dtype=wp.int32), values: wp.array(dtype=wp.float32), result: wp.array(dtype=wp.float32)
) -> None:
    i = wp.tid()
    wp.atomic_max(result, cells[i], values[i])


@wp.kernel
def _compare_kernel(
    result: wp.array(dtype=wp.float32), threshold: wp.float32, occupied: wp.array(dtype=wp.uint8)
) -> None:
    i = wp.tid()
    occupied[i] = wp.where(result[i] >= threshold, wp.uint8(1), wp.uint8(0))


@custom_op("update_occupancy_warp")
def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """The larger of the density found and the decayed old one; see ``voronerf.ops.update_occupancy``."""
    remembered, occupied = density.new_empty(density.shape), density.new_empty(density.shape, dtype=torch.bool)
    yield remembered, occupied
    check_range("update_occupancy", "cells", cells, density.numel())
    tensors = density.reshape(-1), remembered.copy_(density).view(-1), occupied.view(-1), cells
    before, after, over, rows = (array(tensor, density) for tensor in tensors)
    launch(_fade_kernel, cells.shape[0], [before, rows, decay, after], density)
    launch(_raise_kernel, cells.shape[0], [rows, array(values, density), after], density)
    launch(_compare_kernel, density.numel(), [after, threshold, over], density)
