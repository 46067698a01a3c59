"""Look-ups in the tables and planes of all cells at once.

A field reads a table many times in one forward: the eight corners of a voxel, for several levels. The gradient of each
look-up has the size of the whole table, so all look-ups of one table add theirs to one buffer.

Letters: n samples, k cells, e entries of a table with c numbers each.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.router.grouping import Grouping

_WASTE = 512
"""Rows of padding that cost as much as one more call of ``grid_sample``."""


class _Buffer:
    """The sum of the gradients that look-ups of one table have had in this backward pass."""

    def __init__(self) -> None:
        self.sum: Tensor | None = None

    def add(self, like: Tensor, first: int, index: Tensor, gradient: Tensor) -> None:
        if self.sum is None:
            self.sum = torch.zeros_like(like)
        _scatter_add(self.sum.narrow(0, first, like.shape[0] - first), index, gradient)

    def take(self) -> Tensor | None:
        found, self.sum = self.sum, None
        return found


class _Source(torch.autograd.Function):
    """A table [k * e, c] whose gradient is what its look-ups have put into a buffer."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, buffer: _Buffer) -> Tensor:
        ctx.buffer = buffer
        ctx.set_materialize_grads(False)
        return table.view_as(table)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor | None) -> tuple[Tensor | None, None]:
        collected = ctx.buffer.take()
        if collected is None or gradient is None:
            return (gradient if collected is None else collected), None
        return collected + gradient, None


class _LookUp(torch.autograd.Function):
    """Rows of a :class:`_Source`, for indices that count from one of its rows."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, first: int, index: Tensor, buffer: _Buffer) -> Tensor:
        ctx.save_for_backward(table, index)
        ctx.first, ctx.buffer = first, buffer
        return _rows(table.narrow(0, first, table.shape[0] - first), index)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None, None, None]:
        table, index = ctx.saved_tensors
        if torch.is_grad_enabled():  # the gradient has a gradient itself, which a buffer would lose
            return torch.zeros_like(table).index_add(0, index + ctx.first, gradient), None, None, None
        ctx.buffer.add(table, ctx.first, index, gradient)
        return None, None, None, None


class Tables:
    """The tables that a forward has looked up."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, bool], tuple[Tensor, Tensor, _Buffer]] = {}

    def look_up(self, stacked: Tensor, first: int, index: Tensor) -> Tensor:
        """Entries of all cells' tables.

        Args:
            stacked: [k, e, c].
            first: the entry of [k * e, c] that indices count from.
            index: int64 [m].

        Returns:
            [m, c].
        """
        key = id(stacked), torch.is_grad_enabled()
        if key not in self._found:
            buffer, flat = _Buffer(), stacked.reshape(-1, math.prod(stacked.shape[2:]))
            source = _Source.apply(flat, buffer) if flat.requires_grad and key[1] else flat
            self._found[key] = stacked, source, buffer  # ``stacked`` as well: nothing else may get its id
        _, source, buffer = self._found[key]
        found: Tensor = _LookUp.apply(source, first, index, buffer)
        return found


def _pairs(x: Tensor) -> bool:
    """Whether rows are two numbers, which torch moves three times as fast as one complex number."""
    return x.device.type == "cpu" and x.shape[-1] == 2 and x.dtype == torch.float32


def _rows(table: Tensor, index: Tensor) -> Tensor:
    if not _pairs(table):
        return table.index_select(0, index)
    return torch.view_as_real(torch.view_as_complex(table).index_select(0, index))


def _scatter_add(table: Tensor, index: Tensor, rows: Tensor) -> None:
    if _pairs(table):
        rows = torch.view_as_complex(rows.contiguous())
        torch.view_as_complex(table).scatter_add_(0, index, rows)
    else:
        table.index_add_(0, index, rows)


def grid_sample(grouping: Grouping, planes: Tensor, grid: Tensor, place: int, **options: Any) -> Tensor:
    """``F.grid_sample`` of each cell's own plane or volume.

    Args:
        grouping: Of the samples.
        planes: [k, c, h, w] or [k, c, d, h, w].
        grid: [1, ..., 2] or [1, ..., 3].
        place: The dimension of ``grid`` that is the n sorted samples.
        **options: Of ``F.grid_sample``.

    Returns:
        [1, c, ...] with the sizes of ``grid``.
    """
    n, c = grouping.n, planes.shape[1]
    rest = [size for d, size in enumerate(grid.shape[1:-1], 1) if d != place]
    points = grid[0].movedim(place - 1, 0).reshape(n, -1, grid.shape[-1])
    volume = [1] * (planes.dim() - 4)

    def read(own: Tensor, at: Tensor) -> Tensor:
        """[cells, c, h, w] at [cells, rows, q, 2] -> [cells, c, rows, q]."""
        cells, rows, q, _ = at.shape
        return F.grid_sample(own, at.reshape(cells, rows, q, *volume, -1), **options).reshape(cells, c, rows, q)

    occupied = grouping.occupied()
    most = max(last - first for _, first, last in occupied)
    if len(occupied) > 1 and grouping.k * most - n <= _WASTE * len(occupied):
        slots = grouping.slots
        padded = points.new_zeros(grouping.k * most, *points.shape[1:]).index_copy(0, slots, points)
        found = read(planes, padded.reshape(grouping.k, most, *points.shape[1:]))
        found = found.transpose(1, 2).reshape(-1, c, points.shape[1]).index_select(0, slots).transpose(0, 1)[None]
    else:
        own = planes.split(1)
        parts = [read(own[cell], points[None, first:last]) for cell, first, last in occupied]
        found = parts[0] if len(parts) == 1 else torch.cat(parts, 2)
    return found.reshape(1, c, n, *rest).movedim(2, 1 + place)
