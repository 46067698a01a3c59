"""Nearest centre as a Warp kernel. n points, k centres, any number of coordinates.

A thread takes a point and evaluates the definition in float64, each operation rounded on its own (``fuse_fp`` off), so
that the answer is that of the reference and of csrc/ to the last index.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch, of_both_dtypes
from voronerf.ops._core.declare import declared
from voronerf.ops.nearest_centre import check_sizes

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _nearest_centre_kernel(
    points: wp.array2d(dtype=Any), centres: wp.array2d(dtype=Any), cells: wp.array(dtype=wp.int32)
) -> None:
    i = wp.tid()
    best = wp.float64(1.7976931348623157e308)
    cell = wp.int32(0)
    for j in range(centres.shape[0]):
        value = wp.float64(0.0)
        for axis in range(centres.shape[1]):
            difference = wp.float64(points[i, axis]) - wp.float64(centres[j, axis])
            value = value + difference * difference
        # Strict: ties keep the lowest index, and a non-finite point, whose values are NaN or infinite, gets cell 0.
        if value < best:
            best = value
            cell = j
    cells[i] = cell


of_both_dtypes(_nearest_centre_kernel)


@declared("nearest_centre").custom_op("nearest_centre_warp")
def nearest_centre(given: Any, cells: Tensor) -> None:
    """Index of the nearest centre of every point; see ``voronerf.ops.nearest_centre``."""
    check_sizes("nearest_centre", given.centres)
    inputs = [array(tensor, cells) for tensor in (given.points, given.centres, cells)]
    launch(_nearest_centre_kernel, given.n, inputs, cells)
