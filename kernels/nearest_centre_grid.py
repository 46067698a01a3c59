"""Nearest of many frozen centres by a grid of candidate lists, as a Warp kernel. n points, k centres.

A thread takes a point: its cell of the grid, through bricks of finer cells where there are some, and the candidates of
that cell by their float64 distances, each operation rounded on its own. Tables are those of any backend
(``voronerf/ops/centre_grid/reference.py`` says what is in them); points that the grid does not reach meet every centre.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import warp as wp
from torch import Tensor

from voronerf.custom_op import custom_op
from voronerf.kernels._launch import array, filled, launch, of_both_dtypes
from voronerf.ops.centre_grid.reference import BRICK_BITS, CELL_BITS, REACH, GridTables

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_BRICK = wp.constant(BRICK_BITS)
_CELL = wp.constant(CELL_BITS)
_REACH = wp.constant(wp.float64(REACH))


@wp.func
def _cell(u: wp.float64) -> wp.int32:
    """Number of the finest cell along an axis: even steps in the middle, ever longer ones outside."""
    one = wp.float64(1.0)
    three = wp.float64(3.0)
    p = u
    if wp.abs(u) > one:
        p = wp.sign(u) * (one + (one - one / wp.abs(u)) / three)
    side = wp.float64(1 << _CELL)
    return wp.clamp(wp.int32((p + wp.float64(4.0) / three) * wp.float64(0.375) * side), 0, (1 << _CELL) - 1)


@wp.struct
class Grid:
    """The tables of a grid."""

    frame: wp.array2d(dtype=wp.float32)
    entries: wp.array(dtype=wp.int32)
    lists: wp.array(dtype=wp.int32)
    bits: wp.int32


@wp.kernel
def _nearest_centre_grid_kernel(
    points: wp.array2d(dtype=Any),
    centres: wp.array2d(dtype=Any),
    weights: wp.array(dtype=Any),
    weighted: wp.bool,
    grid: Grid,
    cells: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    x = wp.float64(points[i, 0])
    y = wp.float64(points[i, 1])
    z = wp.float64(points[i, 2])
    u = (x - wp.float64(grid.frame[0, 0])) * wp.float64(grid.frame[1, 0])
    v = (y - wp.float64(grid.frame[0, 1])) * wp.float64(grid.frame[1, 1])
    w = (z - wp.float64(grid.frame[0, 2])) * wp.float64(grid.frame[1, 2])
    place = wp.int32(-1)
    count = centres.shape[0]
    if wp.abs(u) <= _REACH and wp.abs(v) <= _REACH and wp.abs(w) <= _REACH:
        a = _cell(u)
        b = _cell(v)
        c = _cell(w)
        shift = _CELL - grid.bits
        entry = grid.entries[((((a >> shift) << grid.bits) + (b >> shift)) << grid.bits) + (c >> shift)]
        while entry < 0 and shift >= _BRICK:
            shift -= _BRICK
            low = (1 << _BRICK) - 1
            slot = (((((a >> shift) & low) << _BRICK) + ((b >> shift) & low)) << _BRICK) + ((c >> shift) & low)
            entry = grid.entries[-1 - entry + slot]
        place = entry
        count = grid.lists[place]
    best = wp.float64(1.7976931348623157e308)
    cell = wp.int32(0)
    for row in range(count):
        j = row
        if place >= 0:
            j = grid.lists[place + 1 + row]
        dx = x - wp.float64(centres[j, 0])
        dy = y - wp.float64(centres[j, 1])
        dz = z - wp.float64(centres[j, 2])
        value = dx * dx + dy * dy + dz * dz
        if weighted:
            value = value - wp.float64(weights[j])
        # Strict: lists rise, so ties keep the lowest index.
        if value < best:
            best = value
            cell = j
    cells[i] = cell


of_both_dtypes(_nearest_centre_grid_kernel)


@custom_op("nearest_centre_grid_warp")
def nearest_centre_grid(points: Tensor, centres: Tensor, weights: Tensor | None, grid: GridTables) -> Iterator[Tensor]:
    """Index of the nearest centre of every point by the candidates of its cell; see ``voronerf.ops.nearest_centre``."""
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    yield cells
    given = [array(tensor, points, points.dtype) for tensor in (points, centres, weights)]
    tables = filled(Grid(), frame=grid.frame, entries=grid.entries, lists=grid.lists, bits=grid.bits)
    inputs = [*given, weights is not None, tables, array(cells, points)]
    launch(_nearest_centre_grid_kernel, points.shape[0], inputs, points)
