"""The rows of the cells: sorted rows with offsets, or rows whose cells are labels or the cells of a diagram.

n samples, k cells, m centres of all diagrams together, g diagrams.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.active import active
from voronerf.ops._core.checks import (
    FLOATING,
    INDEX,
    Others,
    TensorRule,
    check_integer,
    check_range,
    to_common_dtype,
)
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.locate_cell import locate_cell
from voronerf.ops.nearest_centre import nearest_centre

_RULES = {
    "offsets": TensorRule("offsets", INDEX, ("k+1",), empty="must have at least two entries"),
    "order": TensorRule("order", INDEX, ("n",)),
    "cells": TensorRule("cells", INDEX, ("n",)),
    "centres": TensorRule("centres", FLOATING, ("k", 3)),
    "child_offsets": TensorRule("child_offsets", INDEX, ("g+1",)),
    "child": TensorRule("child", INDEX, ("m",)),
    "frozen": TensorRule("frozen", (torch.bool,), ("k",)),
    "rows": TensorRule("rows", INDEX, (1,)),
    "coords": TensorRule("coords", FLOATING, ("n", 3)),
    "centre_index": TensorRule("centre_index", INDEX, ("w",)),
}
_RULES_OF_A_TREE = {**_RULES, "centres": TensorRule("centres", FLOATING, ("m", 3))}


class Sorted(NamedTuple):
    """The rows of each cell: cells int32 [n], or None; the order int32 [n], None if sorted; offsets int32 [k + 1]."""

    cells: Tensor | None
    order: Tensor | None
    offsets: Tensor


class Cells(NamedTuple):
    """The cell of each row: by ``offsets``, by labels ``cells``, or by the centres of a diagram; else one cell.

    Attributes:
        offsets: int32 [k + 1], ascending; cell c owns the sorted rows ``offsets[c]`` to ``offsets[c + 1]``. All other
            attributes but ``order`` must then be None.
        order: int32 [n], the sorted row i is row ``order[i]``; None if the rows are sorted.
        cells: int32 [n], the cell of each row, 0 to k - 1.
        centres: [k, 3], the centres of a flat diagram; or [m, 3], the centres of a tree as in `locate_cell`.
        child_offsets: int32 [g + 1], or None for a flat diagram.
        child: int32 [m], or None for a flat diagram. The leaves are the cells, 0 to k - 1.
        depth: the number of levels of the tree.
        coords: [n, 3], the locations of the rows in the diagram; None for the first three columns of the first input.
        centre_index: the index of the centres of a flat diagram by `index_centres`, or None.
        rows: int32 [1], the number of valid leading rows, for example from `march_rays` with a capacity; None for all.
            Later rows have outputs 0, no gradients, and cell -1. The host does not wait for this number.
        frozen: bool [k], the frozen cells, whose rows have no gradients; or None.
        k: the number of cells; None for as many as the parameters have.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Cells
        >>> labels = torch.tensor([1, 0, 1], dtype=torch.int32)
        >>> Cells(cells=labels).sort(torch.zeros(3, 2), k=2)
        Sorted(cells=tensor([1, 0, 1], dtype=torch.int32), order=tensor([1, 0, 2], dtype=torch.int32), \
offsets=tensor([0, 1, 3], dtype=torch.int32))
    """

    offsets: Tensor | None = None
    order: Tensor | None = None
    cells: Tensor | None = None
    centres: Tensor | None = None
    child_offsets: Tensor | None = None
    child: Tensor | None = None
    depth: int = 1
    coords: Tensor | None = None
    centre_index: Tensor | None = None
    rows: Tensor | None = None
    frozen: Tensor | None = None
    k: int | None = None

    def to_check(self, op: str) -> Others:
        """Checks which arguments were passed together; returns the tensors' rules (shapes, dtypes), and the tensors."""
        if self.offsets is None and self.order is not None:
            raise ValueError(f"{op}: order must come with offsets, got no offsets")
        if self.offsets is not None:
            for name in ("cells", "centres", "rows", "frozen", "k"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{op}: {name} must be None where offsets are given, got both")
        if self.k is not None:
            check_integer(op, "k", self.k, 1)
        if self.centres is None:
            for name, tensor in (("child_offsets", self.child_offsets), ("child", self.child)):
                if tensor is not None:
                    raise ValueError(f"{op}: {name} must come with centres, got no centres")
            if self.coords is not None:
                raise ValueError(f"{op}: coords require centres, got no centres")
            if self.centre_index is not None:
                raise ValueError(f"{op}: centre_index requires centres, got no centres")
        else:
            if self.cells is not None:
                raise ValueError(f"{op}: centres must be None where cells are given, got both")
            if (self.child_offsets is None) != (self.child is None):
                missing = "child_offsets" if self.child_offsets is None else "child"
                raise ValueError(f"{op}: child_offsets and child must come together, got no {missing}")
            if self.child is not None and self.centre_index is not None:
                raise ValueError(f"{op}: centre_index must be None for the centres of a tree, got one")
            check_integer(op, "depth", self.depth, 1)
            if self.child is None and self.depth != 1:
                raise ValueError(f"{op}: depth must be 1 for a flat diagram, got {self.depth}")
        rules: dict[str, TensorRule] = _RULES if self.child is None else _RULES_OF_A_TREE
        values: dict[str, Any] = {name: value for name, value in zip(self._fields, self) if value is not None}
        given = [name for name in values if name in rules]
        return [rules[name] for name in given], [values[name] for name in given]

    def check(self, op: str, positions: Tensor, sizes: dict[str, int]) -> None:
        """Raises ValueError if an argument does not fit the number of cells or the positions.

        Args:
            op: the name of the operation for error messages.
            positions: [n, w], the first input; its first three columns are the coordinates, unless they are given.
            sizes: the size of each dimension by its letter, such as "k" for the number of cells.
        """
        if self.cells is not None:
            check_range(op, "cells", self.cells, sizes["k"])
        if self.centres is None:
            if self.cells is None and self.offsets is None and sizes["k"] != 1:
                raise ValueError(f"{op}: centres or cells must be given for {sizes['k']} cells, got neither")
            return
        if self.child is not None and (sizes["m"] < 1 or sizes["g"] < 1):
            count = f"{sizes['m']} centres in {sizes['g']} diagrams"
            raise ValueError(f"{op}: centres must hold at least one centre of one diagram, got {count}")
        if self.coords is None and positions.shape[1] < 3:
            got = positions.shape[1]
            raise ValueError(f"{op}: coords must be given for positions with fewer than 3 features, got {got}")

    def sort(self, positions: Tensor, k: int, backend: str = "auto") -> Sorted:
        """Finds the cells of rows and sorts the rows by cell.

        Args:
            positions: [n, w], the first input of the network.
            k: the number of cells.
            backend: the backend of the operations that it calls.
        """
        if self.offsets is not None:
            return Sorted(None, self.order, self.offsets)
        cells = self.cells
        if cells is None:
            if k == 1:
                return _one_cell(positions, self.rows)
            assert self.centres is not None
            coords, centres = to_common_dtype(positions[:, :3] if self.coords is None else self.coords, self.centres)
            index = self.centre_index if centres.dtype is self.centres.dtype else None
            if self.rows is not None and _on_cuda(coords, backend):
                cells = _find_valid(coords, centres, (self.child_offsets, self.child, self.depth), self.rows, index)
                return Sorted(cells, *cell_sort(cells, k, backend=backend))
            if self.child_offsets is None or self.child is None:
                cells = nearest_centre(coords, centres, index=index, backend=backend)
            else:
                cells = locate_cell(coords, centres, self.child_offsets, self.child, depth=self.depth, backend=backend)
        if self.rows is None:
            order, offsets = cell_sort(cells, k, backend=backend)
            return Sorted(cells, order, offsets)
        valid = torch.arange(cells.shape[0], device=cells.device) < self.rows
        order, offsets = cell_sort(torch.where(valid, cells, k), k + 1, backend=backend)
        return Sorted(torch.where(valid, cells, -1), order, offsets[:-1])


def _on_cuda(coords: Tensor, backend: str) -> bool:
    """Returns whether compiled CUDA kernels find the cells."""
    native = backends.compiled()
    if native is None or not native.on_cuda(coords):
        return False
    return backends.chosen("nearest_centre", coords.device, coords.dtype, backend=backend) == "native"


def _find_valid(coords: Tensor, centres: Tensor, tree: Any, rows: Tensor, index: Tensor | None) -> Tensor:
    """Returns the cells on CUDA, without further launches for invalid rows: -1 for the rows after the first ``rows``.

    ``cell_sort`` on CUDA leaves rows of cell -1 outside all cells.
    """
    from voronerf.ops.locate_cell import native as trees
    from voronerf.ops.nearest_centre import native as diagrams

    cells = coords.new_empty(coords.shape[0], dtype=torch.int32)
    if tree[0] is None:
        diagrams.find(cells, coords, centres, rows, index)
    else:
        trees.find(cells, coords, centres, tree, "locate_cell", rows)
    return cells


def _one_cell(positions: Tensor, rows: Tensor | None) -> Sorted:
    """Returns the rows of one cell, which need no sorting; ``rows`` is the number of valid leading rows, or None."""
    n, device = positions.shape[0], positions.device
    if active.recording is not None and (native := backends.compiled()) is not None:
        count, positions = rows_of(positions), positions.detach()
        cells, offsets = new_empty(positions, count, dtype=torch.int32), positions.new_empty(2, dtype=torch.int32)
        native.compiled.one_cell(cells, offsets, count, native.cpu())
        return Sorted(cells, None, offsets)
    cells = torch.zeros(n, dtype=torch.int32, device=device)
    if rows is None:
        return Sorted(cells, None, torch.arange(2, dtype=torch.int32, device=device) * n)
    beyond = torch.arange(n, device=device) >= rows
    return Sorted(cells.masked_fill(beyond, -1), None, torch.nn.functional.pad(rows.clamp(0, n), (1, 0)))
