"""Nearest centre as a Warp kernel. n points, k centres, any number of coordinates.

One thread evaluates the definition for one point in float64. Each operation is rounded separately (``fuse_fp`` off), so
that all indices equal the results of the reference and of csrc/.
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
        # The comparison is strict: ties keep the lowest index, and a non-finite point, with NaN or infinite values,
        # gets cell 0.
        if value < best:
            best = value
            cell = j
    cells[i] = cell


of_both_dtypes(_nearest_centre_kernel)


@declared("nearest_centre").custom_op("nearest_centre_warp")
def nearest_centre(arguments: Any, cells: Tensor) -> None:
    """Writes the index of the nearest centre of every point; see ``voronerf.ops.nearest_centre``."""
    check_sizes("nearest_centre", arguments.centres)
    inputs = [array(tensor, cells) for tensor in (arguments.points, arguments.centres, cells)]
    launch(_nearest_centre_kernel, arguments.n, inputs, cells)
