"""The hash encoding as Warp kernels. n points, k tables, e entries in all levels, f features per level.

One thread handles one level of one point, in the forward pass and for the gradient of the table. Atomics sum this
gradient, so that on a GPU its last bits depend on the order. For the gradient of the positions one thread handles one
point. If each point has a direction, the encoding is replaced by its derivative along this direction: the weight of
each corner becomes its directional derivative.
"""

from __future__ import annotations

import functools

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.checks import check_range
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.grids import HashGrid
from voronerf.ops.hash_encode.autograd import HashDerivatives, Hashed, HashedGradient

wp.set_module_options({"enable_backward": False})

_PRIME_Y, _PRIME_Z = wp.constant(wp.uint32(2654435761)), wp.constant(wp.uint32(805459861))


@wp.struct
class Grid:
    """The grid's constants: box, features per level, number of tables, entries of a table.

    ``numbers`` [levels, 2] holds scale and shift; ``sizes`` [levels, 4] holds side, entries, offset and hashed flag.
    """

    low: wp.vec3
    inverse: wp.vec3
    along: wp.bool
    features: wp.int32
    entries: wp.int32
    tables: wp.int32
    several: wp.bool
    numbers: wp.array2d(dtype=wp.float32)
    sizes: wp.array2d(dtype=wp.int32)


@wp.struct
class Place:
    """The voxel of a point on a level: the indices of the lower corner, and the weights of the upper corner.

    ``upper`` holds the upper corner's weight on each axis, ``slope`` the weight's derivative.
    """

    x: wp.int32
    y: wp.int32
    z: wp.int32
    upper: wp.vec3
    slope: wp.vec3


@wp.func
def _place(positions: wp.array2d(dtype=wp.float32), i: wp.int32, level: wp.int32, grid: Grid) -> Place:
    result = Place()
    corners = wp.vec3(0.0, 0.0, 0.0)  # integers below 2^24
    for axis in range(3):
        place = (positions[i, axis] - grid.low[axis]) * grid.inverse[axis]
        slope = wp.float32(0.0)
        if place >= 0.0 and place <= 1.0:
            slope = grid.inverse[axis] * grid.numbers[level, 0]
        if place < 0.0:
            place = wp.float32(0.0)
        if place > 1.0:
            place = wp.float32(1.0)
        where = place * grid.numbers[level, 0] + grid.numbers[level, 1]
        corner = wp.float32(0.0)
        if where > 0.0:  # not NaN
            corner = wp.floor(where)
        corners[axis] = corner
        result.upper[axis] = where - corner
        result.slope[axis] = slope
    result.x = wp.int32(corners[0])
    result.y = wp.int32(corners[1])
    result.z = wp.int32(corners[2])
    return result


@wp.func
def _entry(place: Place, corner: wp.int32, level: wp.int32, grid: Grid) -> wp.int32:
    x = place.x + (corner & 1)
    y = place.y + ((corner >> 1) & 1)
    z = place.z + (corner >> 2)
    side = grid.sizes[level, 0]
    entries = grid.sizes[level, 1]
    if grid.sizes[level, 3] != 0:
        hashed = wp.uint32(x) ^ (wp.uint32(y) * _PRIME_Y) ^ (wp.uint32(z) * _PRIME_Z)
        return grid.sizes[level, 2] + wp.int32(hashed & wp.uint32(entries - 1))
    entry = x + side * (y + side * z)
    if entry >= entries:
        entry -= entries
    return grid.sizes[level, 2] + entry


@wp.func
def _of_corner(upper: wp.vec3, corner: wp.int32, one: wp.float32) -> wp.vec3:
    """Returns the weight of a corner on each axis, from the weight of the upper corner, ``upper``.

    The weight of the lower corner is ``one - upper``: ``one`` is 1 for weights and 0 for their derivatives.
    """
    weights = upper
    for axis in range(3):
        if ((corner >> axis) & 1) == 0:
            weights[axis] = one - upper[axis]
    return weights


@wp.func
def _start(cells: wp.array(dtype=wp.int32), i: wp.int32, grid: Grid) -> wp.int64:
    if grid.several:
        return wp.int64(wp.clamp(cells[i], 0, grid.tables - 1)) * wp.int64(grid.entries)
    return wp.int64(0)


@wp.func
def _weight(
    place: Place, corner: wp.int32, direction: wp.array2d(dtype=wp.float32), i: wp.int32, grid: Grid
) -> wp.float32:
    at = _of_corner(place.upper, corner, wp.float32(1.0))
    if not grid.along:
        return at[0] * at[1] * at[2]
    slope = _of_corner(place.slope, corner, wp.float32(0.0))
    return (
        direction[i, 0] * slope[0] * at[1] * at[2]
        + direction[i, 1] * slope[1] * at[0] * at[2]
        + direction[i, 2] * slope[2] * at[0] * at[1]
    )


@wp.kernel
def _encode_kernel(
    positions: wp.array2d(dtype=wp.float32),
    direction: wp.array2d(dtype=wp.float32),
    table: wp.array2d(dtype=wp.float32),
    cells: wp.array(dtype=wp.int32),
    grid: Grid,
    out: wp.array2d(dtype=wp.float32),
) -> None:
    i, level = wp.tid()
    place = _place(positions, i, level, grid)
    start = _start(cells, i, grid)
    for f in range(grid.features):
        out[i, level * grid.features + f] = wp.float32(0.0)
    for corner in range(8):
        row = start + wp.int64(_entry(place, corner, level, grid))
        weight = _weight(place, corner, direction, i, grid)
        for f in range(grid.features):
            out[i, level * grid.features + f] = out[i, level * grid.features + f] + weight * table[row, f]


@wp.kernel
def _table_kernel(
    gradient: wp.array2d(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.float32),
    direction: wp.array2d(dtype=wp.float32),
    cells: wp.array(dtype=wp.int32),
    grid: Grid,
    of_table: wp.array2d(dtype=wp.float32),
) -> None:
    i, level = wp.tid()
    place = _place(positions, i, level, grid)
    start = _start(cells, i, grid)
    for corner in range(8):
        row = start + wp.int64(_entry(place, corner, level, grid))
        weight = _weight(place, corner, direction, i, grid)
        for f in range(grid.features):
            wp.atomic_add(of_table, row, wp.int64(f), weight * gradient[i, level * grid.features + f])


@wp.kernel
def _positions_kernel(
    gradient: wp.array2d(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.float32),
    direction: wp.array2d(dtype=wp.float32),
    table: wp.array2d(dtype=wp.float32),
    cells: wp.array(dtype=wp.int32),
    grid: Grid,
    of_positions: wp.array2d(dtype=wp.float32),
) -> None:
    i = wp.tid()
    start = _start(cells, i, grid)
    total = wp.vec3(0.0, 0.0, 0.0)
    for level in range(grid.numbers.shape[0]):
        place = _place(positions, i, level, grid)
        for corner in range(8):
            row = start + wp.int64(_entry(place, corner, level, grid))
            product = wp.float32(0.0)
            for f in range(grid.features):
                product += gradient[i, level * grid.features + f] * table[row, f]
            at = _of_corner(place.upper, corner, wp.float32(1.0))
            slope = _of_corner(place.slope, corner, wp.float32(0.0))
            for axis in range(3):
                b = (axis + 1) % 3
                c = (axis + 2) % 3
                change = slope[axis] * at[b] * at[c]
                if grid.along:
                    change = slope[axis] * (direction[i, b] * slope[b] * at[c] + direction[i, c] * slope[c] * at[b])
                # Outside the box the gradient is 0, even if a product is NaN.
                if place.slope[axis] != 0.0:
                    total[axis] = total[axis] + change * product
    for axis in range(3):
        of_positions[i, axis] = total[axis]


def hash_encode(positions: Tensor, table: Tensor, grid: HashGrid, cells: Tensor | None = None) -> Tensor:
    """Returns features [n, levels * f] of points from a table [e, f] or [k, e, f]; see ``voronerf.ops.hash_encode``."""
    encoded: Tensor = _encode(positions.float(), table.float(), None, cells, grid.text)
    return encoded


@custom_op("hash_encode_warp", Hashed.result)
def _encode(arguments: Hashed, out: Tensor) -> None:
    points, tables, rows = _inputs(arguments, arguments.table)
    levels = HashGrid.parse(arguments.grid).levels
    if arguments.cells is not None:
        check_range("hash_encode", "cells", arguments.cells, len(arguments.table))
    launch(_encode_kernel, (len(out), levels), [*points, rows, *tables, array(out, out)], out)


@custom_op("hash_encode_warp_backward", HashedGradient.results)
def _backward(backward_arguments: HashedGradient, results: list[Tensor]) -> None:
    (gradient, arguments, to_positions, to_table), (of_positions, of_table) = backward_arguments, results
    n, levels, arriving = len(gradient), HashGrid.parse(arguments.grid).levels, array(gradient, gradient)
    if to_table:
        points, tables, rows = _inputs(arguments, of_table.zero_())
        launch(_table_kernel, (n, levels), [arriving, *points, *tables, rows], gradient)
    if to_positions:
        points, tables, rows = _inputs(arguments, arguments.table)
        inputs = [arriving, *points, rows, *tables, array(of_positions, gradient)]
        launch(_positions_kernel, n, inputs, gradient)


def _inputs(arguments: Hashed, table: Tensor) -> tuple[list[object], list[object], object]:
    """Returns the kernels' arguments: [positions, directions], [cells, grid], and the table as rows of f features."""
    positions, cells, direction = arguments.positions, arguments.cells, arguments.direction
    along = positions[:0] if direction is None else direction
    levels, grid = HashGrid.parse(arguments.grid), Grid()
    low, high = levels.box
    grid.low, grid.inverse = wp.vec3(*low), wp.vec3(*(1 / (b - a) for a, b in zip(low, high)))
    grid.along = direction is not None
    grid.features, grid.entries, grid.several = levels.features, arguments.table.shape[-2], cells is not None
    grid.tables = arguments.table.shape[0]
    numbers, sizes = _levels(arguments.grid, positions.device)
    grid.numbers, grid.sizes = array(numbers, positions), array(sizes, positions)
    points: list[object] = [array(positions, positions), array(along, positions)]
    return points, [array(cells, positions, torch.int32), grid], array(table.reshape(-1, levels.features), positions)


@functools.lru_cache(maxsize=64)
def _levels(text: str, device: torch.device) -> tuple[Tensor, Tensor]:
    rows = HashGrid.parse(text).rows
    numbers = torch.tensor([[row.scale, row.shift] for row in rows], dtype=torch.float32, device=device)
    sizes = [[row.side, row.entries, row.offset, row.hashed] for row in rows]
    return numbers, torch.tensor(sizes, dtype=torch.int32, device=device)


HashDerivatives(_encode, _backward)
