"""Samples sorted by cell: the order, its inverse, and what running a module on the sorted rows needs to know.

n samples, k cells, e entries of a table with c numbers each. A sorted tensor may have m entries a sample: its first
dimension is then n * m, sample after sample.
"""

from __future__ import annotations

import functools
import itertools
import math
import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf import ops


class Grouping:
    """An assignment of n samples to k cells, sorted.

    ``tables`` are what ``routed_mlp`` finds the cells with; None where there is one cell or the cells are given.
    """

    def __init__(
        self,
        cells: Tensor | Callable[[], Tensor] | None,
        n: int,
        k: int,
        device: torch.device,
        backend: str,
        tables: dict[str, Any] | None = None,
    ) -> None:
        self.n, self.k, self.backend, self.tables, self._cells = n, k, backend, tables, cells
        self.device = device
        self.start = self._first = 0  # of the cells and rows of a part
        self._entry_offsets: dict[tuple[int, int], Tensor] = {}

    @property
    def cells(self) -> Tensor | None:
        """int32 [n], the cell of each sample in the original order; None where there is one cell."""
        if not (self._cells is None or isinstance(self._cells, Tensor)):
            self.found(self._cells())
        assert self._cells is None or isinstance(self._cells, Tensor)
        return self._cells

    def found(self, cells: Tensor) -> None:
        """Takes over cells that ``tables`` gave."""
        self._cells, self.tables = cells, None

    @functools.cached_property
    def _sorted(self) -> tuple[Tensor | None, Tensor]:
        if self.cells is None:
            return None, torch.tensor([0, self.n], dtype=torch.int32, device=self.device)
        return ops.cell_sort(self.cells, self.k, backend=self.backend)

    @property
    def order(self) -> Tensor | None:
        """int32 [n], the original row of each sorted row; None where there is one cell."""
        return self._sorted[0]

    @property
    def offsets(self) -> Tensor:
        """int32 [k + 1]; cell c owns sorted rows ``offsets[c]`` to ``offsets[c + 1]``."""
        return self._sorted[1]

    @functools.cached_property
    def inverse(self) -> Tensor | None:
        """int32 [n], the sorted row of each original row."""
        return None if self.order is None else _inverse(self.order)

    @functools.cached_property
    def sorted_cells(self) -> Tensor:
        """int64 [n], the cell of each sorted row."""
        if self.cells is None or self.order is None:
            return torch.zeros(self.n, dtype=torch.int64, device=self.offsets.device)
        return self.cells.index_select(0, self.order).long()

    def scaled_offsets(self, m: int) -> Tensor:
        """``offsets`` of tensors with m entries a sample."""
        return self.offsets if m == 1 else self.offsets * m

    @functools.cached_property
    def _bounds(self) -> list[int]:
        return self.offsets.tolist()

    def occupied(self) -> list[tuple[int, int, int]]:
        """(cell, first row, row behind the last) of every cell that has samples; reads them on the host."""
        pairs = enumerate(itertools.pairwise(self._bounds))
        return [(cell, first, last) for cell, (first, last) in pairs if last > first]

    def parts(self, rows: int) -> list[Grouping]:
        """Sorted rows in parts of whole cells, at most ``rows`` each; a cell of more is cut into parts of its own."""
        if self.n <= rows:
            return [self]
        groups, start, begin = [], 0, 0
        for cell, first, last in self.occupied():
            if last - begin > rows and first > begin:
                groups.append((start, cell, begin, first))
                start, begin = cell, first
        groups.append((start, self.k, begin, self.n))
        parts: list[Grouping] = []
        for start, stop, first, last in groups:
            count = -(-(last - first) // rows)
            edges = [first + (last - first) * i // count for i in range(count + 1)]
            parts += [Part(self, start, stop, *edge) for edge in itertools.pairwise(edges)]
        return parts

    def entry_offsets(self, entries: int, m: int) -> Tensor:
        """int64 [n * m], where the entries of each row's cell begin in a table of all cells."""
        if (entries, m) not in self._entry_offsets:
            first = self.sorted_cells * entries
            self._entry_offsets[entries, m] = first if m == 1 else first.repeat_interleave(m)
        return self._entry_offsets[entries, m]

    @functools.cached_property
    def slots(self) -> Tensor:
        """int64 [n], the row of each sorted row where every cell has room for as many as the fullest."""
        most = max(last - first for _, first, last in self.occupied())
        starts = torch.arange(self.k, device=self.device) * most - self.offsets[:-1]
        return torch.arange(self.n, device=self.device) + starts[self.sorted_cells]

    def sort(self, x: Tensor) -> Tensor:
        """[n, ...] in the original order -> sorted by cell."""
        return x if self.order is None else permute(x, self.order, self.inverse)

    def rays(self, samples: int) -> Tensor:
        """int32 [n], the ray of each sorted row, for a number of samples a ray."""
        rows = self.order
        if rows is None:
            rows = torch.arange(self._first, self._first + self.n, dtype=torch.int32, device=self.device)
        return torch.div(rows, samples, rounding_mode="floor")

    def unsort(self, x: Tensor) -> Tensor:
        """[n, ...] sorted by cell -> the original order."""
        return x if self.order is None else permute(x, self.inverse, self.order)

    def expand(self, stacked: Tensor, m: int = 1) -> Tensor:
        """[k, ...] -> [n * m, ...]: the entry of each row's cell."""
        # Copies under all settings: a product in TF32 would round them.
        rounds = stacked.is_cuda and torch.backends.cuda.matmul.fp32_precision == "tf32"
        if not stacked.is_floating_point() or stacked[0].numel() == 0 or rounds:
            rows = self.sorted_cells if m == 1 else self.sorted_cells.repeat_interleave(m)
            return stacked.index_select(0, rows)
        # A grouped layer without inputs: its backward sums over each cell's rows, where that of indexing would scatter.
        ones = stacked.new_ones(self.n * m, 1)
        weight = stacked.reshape(self.k, -1, 1)
        with torch.autocast(stacked.device.type, enabled=False):
            rows = ops.grouped_linear(ones, self.scaled_offsets(m), weight, backend=self.backend)
        return rows.reshape(self.n * m, *stacked.shape[1:])


class Entries(Grouping):
    """Samples in cells that are not their own: each entry names a sample, any number of times, and a cell.

    ``order`` gives the sample of each sorted entry, and ``unsort`` the order of the entries: samples ``rows``, int64
    [m], in ``cells``, int32 [m].
    """

    def __init__(self, rows: Tensor, cells: Tensor, k: int, backend: str) -> None:
        super().__init__(cells, rows.shape[0], k, cells.device, backend)
        order, offsets = ops.cell_sort(cells, k, backend=backend)
        self._sorted = rows.to(torch.int32).index_select(0, order), offsets
        self.sorted_cells = cells.index_select(0, order).long()
        self._place = _inverse(order)

    def sort(self, x: Tensor) -> Tensor:
        """[samples, ...] -> [m, ...], the entries sorted by cell."""
        assert self.order is not None
        return x.index_select(0, self.order)

    def unsort(self, x: Tensor) -> Tensor:
        """[m, ...] sorted by cell -> the order of the entries."""
        return x.index_select(0, self._place)


class Part(Grouping):
    """Sorted rows ``first`` to ``last`` of cells ``start`` to ``stop`` of a grouping, as a grouping of these cells.

    Its arguments are found in those of all samples.
    """

    def __init__(self, whole: Grouping, start: int, stop: int, first: int, last: int) -> None:
        super().__init__(None, last - first, stop - start, whole.device, whole.backend)
        order = whole.order
        offsets = whole.offsets[start : stop + 1].clamp(first, last) - first
        self._sorted = (None if order is None else order[first:last]), offsets
        self.sorted_cells = whole.sorted_cells[first:last] - start
        self._first, self.start = first, start

    def sort(self, x: Tensor) -> Tensor:
        """[samples of the whole, ...] in the original order -> this part's rows."""
        if self.order is None:
            return x[self._first : self._first + self.n]
        # The gradient is added three times as fast by int64 indices.
        return x.index_select(0, self.order.long() if x.requires_grad else self.order)


class _Permute(torch.autograd.Function):
    """Rows in another order. The backward is a gather as well, where that of indexing would be a scatter-add."""

    @staticmethod
    def forward(x: Tensor, index: Tensor, inverse: Tensor) -> Tensor:
        return x.index_select(0, index)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1], inputs[2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        index, inverse = ctx.saved_tensors
        return permute(gradient, inverse, index), None, None


def _inverse(order: Tensor) -> Tensor:
    """int32 [n]: where each number is in a permutation."""
    rows = torch.arange(order.shape[0], dtype=torch.int32, device=order.device)
    return torch.empty_like(order).scatter_(0, order.long(), rows)


def permute(x: Tensor, index: Tensor | None, inverse: Tensor | None) -> Tensor:
    """``x[index]`` for a permutation whose inverse is known."""
    if x.requires_grad and torch.is_grad_enabled():
        permuted: Tensor = _Permute.apply(x, index, inverse)
        return permuted
    assert index is not None
    return x.index_select(0, index)


class Assignments:
    """The last assignment, for other methods that are called with the same positions."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._source: weakref.ref[Tensor] | None = None
        self._version = 0
        self._positions: Tensor | None = None
        self._methods: set[str] = set()
        self._grouping: Grouping | None = None

    def find(self, method: str, source: Tensor | None, positions: Tensor, key: tuple[Any, ...]) -> Grouping | None:
        """The assignment made for the same positions, or None. One that was drawn serves each method once.

        ``source`` is the tensor that holds the positions [..., 3], or None where they have been computed.
        """
        if self._grouping is None or key != self._key or positions.numel() == 0:
            return None
        if source is not None:
            known = self._source is not None and self._source() is source and source._version == self._version
        else:
            known = (
                self._positions is not None
                and self._positions.shape == positions.shape
                and self._positions.device == positions.device
                and torch.equal(self._positions, positions)
            )
        drawn = key[2]
        if not known or (drawn and method in self._methods):
            return None
        self._methods.add(method)
        return self._grouping

    def keep(
        self, method: str, source: Tensor | None, positions: Tensor, key: tuple[Any, ...], grouping: Grouping
    ) -> None:
        """Remembers an assignment."""
        if source is not None and source.is_inference():  # has no version that would tell of changes
            self._grouping = None
            return
        self._key, self._methods, self._grouping = key, {method}, grouping
        self._source = None if source is None else weakref.ref(source)
        self._version = 0 if source is None else source._version
        self._positions = positions.detach().clone() if source is None else None


# Look-ups -------------------------------------------------------------------------------------------------------------
# A field reads a table many times in one forward: the eight corners of a voxel, for several levels. The gradient of
# each look-up has the size of the whole table, so all look-ups of one table add theirs to one buffer.


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
