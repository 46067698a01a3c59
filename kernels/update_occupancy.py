"""Updating an occupancy grid as Warp kernels. n cells, q of them updated."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

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


def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, *, decay: float, threshold: float
) -> tuple[Tensor, Tensor]:
    """The larger of the density found and the decayed old one; see ``voronerf.ops.update_occupancy``."""
    remembered, occupied = _update(density, cells, values, decay, threshold)
    return remembered, occupied


@torch.library.custom_op("voronerf::update_occupancy_warp", mutates_args=())
def _update(density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float) -> tuple[Tensor, Tensor]:
    if not cells.is_cuda and cells.shape[0] > 0:
        low, high = (int(bound) for bound in cells.aminmax())
        if low < 0 or high >= density.numel():
            raise ValueError(
                f"update_occupancy: cells must lie in 0 to {density.numel() - 1}, got values from {low} to {high}"
            )
    flat = density.reshape(-1)
    result = flat.clone()
    occupied = torch.empty_like(result, dtype=torch.bool)
    before, after, rows = (array(tensor, density) for tensor in (flat, result, cells))
    launch(_fade_kernel, cells.shape[0], [before, rows, decay, after], density)
    launch(_raise_kernel, cells.shape[0], [rows, array(values, density), after], density)
    launch(_compare_kernel, flat.shape[0], [after, threshold, array(occupied, density)], density)
    return result.reshape(density.shape), occupied.reshape(density.shape)


@_update.register_fake
def _(density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float) -> tuple[Tensor, Tensor]:
    return density.new_empty(density.shape), density.new_empty(density.shape, dtype=torch.bool)
