"""Nearest centre as a Warp kernel. n points, k centres.

A thread takes a point and evaluates the definition in float64, each operation rounded on its own (``fuse_fp`` off), so
that the answer is that of the reference and of csrc/ to the last index.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _nearest_centre_kernel(
    points: wp.array2d(dtype=Any),
    centres: wp.array2d(dtype=Any),
    weights: wp.array(dtype=Any),
    weighted: wp.bool,
    cells: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    x = wp.float64(points[i, 0])
    y = wp.float64(points[i, 1])
    z = wp.float64(points[i, 2])
    best = wp.float64(1.7976931348623157e308)
    cell = wp.int32(0)
    for j in range(centres.shape[0]):
        dx = x - wp.float64(centres[j, 0])
        dy = y - wp.float64(centres[j, 1])
        dz = z - wp.float64(centres[j, 2])
        value = dx * dx + dy * dy + dz * dz
        if weighted:
            value = value - wp.float64(weights[j])
        # Strict: ties keep the lowest index, and a non-finite point, whose values are NaN or infinite, gets cell 0.
        if value < best:
            best = value
            cell = j
    cells[i] = cell


for _scalar in (wp.float32, wp.float64):
    wp.overload(
        _nearest_centre_kernel,
        [
            wp.array2d(dtype=_scalar),
            wp.array2d(dtype=_scalar),
            wp.array(dtype=_scalar),
            wp.bool,
            wp.array(dtype=wp.int32),
        ],
    )


def nearest_centre(points: Tensor, centres: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Index of the centre with the smallest ``|x - c|^2 - w`` for every point; see ``voronerf.ops.nearest_centre``."""
    cells: Tensor = _nearest_centre(points.detach(), centres.detach(), None if weights is None else weights.detach())
    return cells


@torch.library.custom_op("voronerf::nearest_centre_warp", mutates_args=())
def _nearest_centre(points: Tensor, centres: Tensor, weights: Tensor | None) -> Tensor:
    given = (points, centres) if weights is None else (points, centres, weights)
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in given) else torch.float32
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    if points.shape[0] == 0:
        return cells
    # Strides are passed on: only tensors of another dtype are copied.
    arrays = [wp.from_torch(tensor.to(dtype)) for tensor in given]
    arrays += [wp.empty(0, dtype=arrays[0].dtype, device=arrays[0].device)] if weights is None else []
    stream = wp.stream_from_torch(points.device) if points.is_cuda else None
    inputs = [*arrays, weights is not None, wp.from_torch(cells)]
    wp.launch(_nearest_centre_kernel, dim=points.shape[0], inputs=inputs, device=arrays[0].device, stream=stream)
    return cells


@_nearest_centre.register_fake
def _(points: Tensor, centres: Tensor, weights: Tensor | None) -> Tensor:
    return points.new_empty(points.shape[0], dtype=torch.int32)
