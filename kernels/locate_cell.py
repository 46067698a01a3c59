"""``locate_cell`` as a Warp kernel. n points, m centres in all diagrams, g diagrams.

One thread moves one point down the tree. Distances are float64, each operation rounded separately, as in the reference.
Nothing outside the tables is read; a walk that leads out of them or reaches no leaf gives a negative number.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch, of_both_dtypes
from voronerf.ops._core.declare import declared
from voronerf.ops.locate_cell.reference import check_leaves, check_tree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _locate_cell_kernel(
    points: wp.array2d(dtype=Any),
    centres: wp.array2d(dtype=Any),
    child_offsets: wp.array(dtype=wp.int32),
    child: wp.array(dtype=wp.int32),
    depth: wp.int32,
    leaves: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    x = wp.float64(points[i, 0])
    y = wp.float64(points[i, 1])
    z = wp.float64(points[i, 2])
    # The point's diagram, or a negative number for its leaf.
    state = wp.int32(0)
    for _ in range(depth):
        if state >= 0 and state < child_offsets.shape[0] - 1:
            first = wp.max(child_offsets[state], 0)
            last = wp.min(child_offsets[state + 1], centres.shape[0])
            best = wp.float64(1.7976931348623157e308)
            nearest = first
            for j in range(first, last):
                dx = x - wp.float64(centres[j, 0])
                dy = y - wp.float64(centres[j, 1])
                dz = z - wp.float64(centres[j, 2])
                value = dx * dx + dy * dy + dz * dz
                # The comparison is strict: ties keep the lowest index, and a point that is not finite takes the first
                # centre.
                if value < best:
                    best = value
                    nearest = j
            if first < last:
                state = child[nearest]
            else:
                state = child_offsets.shape[0]
    leaves[i] = -state - 1


of_both_dtypes(_locate_cell_kernel)


@declared("locate_cell").custom_op("locate_cell_warp")
def locate_cell(arguments: Any, leaves: Tensor) -> None:
    """Writes the leaf of every point in a tree of diagrams; see ``voronerf.ops.locate_cell``."""
    *tables, depth = arguments
    check_tree(arguments.child_offsets, arguments.child, "locate_cell")
    levels = min(depth, arguments.child_offsets.shape[0] - 1)  # a tree has at most one level per diagram
    inputs = [*[array(tensor, leaves) for tensor in tables], levels, array(leaves, leaves)]
    launch(_locate_cell_kernel, arguments.n, inputs, leaves)
    check_leaves(leaves, depth, "locate_cell")
