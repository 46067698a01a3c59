"""The hash encoding of Instant NGP. n points, k tables, e entries of all levels, f features of a level."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.ops._core.grids import GridLevel, HashGrid

_PRIMES = (1, 2654435761, 805459861)


def hash_encode(positions: Tensor, table: Tensor, grid: HashGrid, cells: Tensor | None = None) -> Tensor:
    """Returns the features [n, levels * f] of points; see ``voronerf.ops.hash_encode``."""
    if cells is not None:
        check_range("hash_encode", "cells", cells, len(table))
    return interpolate(positions, table, grid, cells)


def interpolate(positions: Tensor, table: Tensor, grid: HashGrid, cells: Tensor | None) -> Tensor:
    """Returns the features of points, without checking the cells."""
    dtype = torch.promote_types(torch.promote_types(positions.dtype, table.dtype), torch.float32)
    low, high = torch.tensor(grid.box, dtype=dtype, device=positions.device)
    places = ((positions.to(dtype) - low) * (1 / (high - low))).clamp(0, 1)
    start = 0 if cells is None else cells.long() * table.shape[-2]
    rows = table.reshape(-1, grid.features).to(dtype)  # the table's gradient is summed in this dtype
    return torch.cat([_level(places, rows, start, level, grid) for level in grid.rows], dim=1)


def _level(places: Tensor, rows: Tensor, start: Tensor | int, level: GridLevel, grid: HashGrid) -> Tensor:
    where = places * level.scale + level.shift
    corner = where.detach().floor()
    inside = where - corner
    corner = corner.nan_to_num(0).long()
    total = places.new_zeros(len(places), grid.features)
    for step in itertools.product((0, 1), repeat=3):
        weight = places.new_ones(len(places))
        for axis, one in enumerate(step):
            weight = weight * (inside[:, axis] if one else 1 - inside[:, axis])
        entry = start + level.offset + _entry(corner + corner.new_tensor(step), level)
        total = total + weight[:, None] * rows[entry]
    return total


def _entry(corner: Tensor, level: GridLevel) -> Tensor:
    """Returns the entry [n] of corners [n, 3] within their level."""
    if not level.hashed:
        return (corner * corner.new_tensor([1, level.side, level.side**2])).sum(1) % level.entries
    # Only the lowest bits count; they equal the lowest bits of uint32 arithmetic.
    x, y, z = (corner * corner.new_tensor(_PRIMES)).unbind(1)
    return (x ^ y ^ z) & (level.entries - 1)
