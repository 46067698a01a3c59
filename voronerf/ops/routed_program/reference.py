"""Programs on samples in the cells of a diagram: find the cells, sort, run, put the results back in order.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams, w columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.checks import check_range
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.grouped_program.given import Given
from voronerf.ops.locate_cell import locate_cell
from voronerf.ops.nearest_centre import nearest_centre
from voronerf.ops.routed_program.where import Where


def routed_program(given: Given, where: Where, backend: str = "reference") -> tuple[list[Tensor], Tensor]:
    """Outputs in the order of the samples, and the cells; see ``voronerf.ops.routed_program``.

    ``backend`` is that of the operations it is made of.
    """
    k, n, device = cells_of(given.parameters), given.inputs[0].shape[0], given.inputs[0].device
    cells, order = find_cells(given.caller, where, k, backend), None
    if cells is None:
        cells = torch.zeros(n, dtype=torch.int32, device=device)
        offsets = torch.tensor([0, n], dtype=torch.int32, device=device)
    else:
        order, offsets = cell_sort(cells, k, backend=backend)
    return first_rows(given.run(offsets, order, backend=backend), cells, where.rows)


def cells_of(parameters: Sequence[Tensor]) -> int:
    """k, of parameters [k, ...] and those [1, ...] that all cells share."""
    return next((p.shape[0] for p in parameters if p.shape[0] != 1), 1)


def find_cells(op: str, where: Where, k: int, backend: str) -> Tensor | None:
    """int32 [n], the cells of samples; None where there is one."""
    centres, child_offsets, child, depth, cells, coords, *_, index = where
    if cells is None and k == 1:
        return None
    if cells is None:
        assert coords is not None and centres is not None
        if child_offsets is None or child is None:
            cells = nearest_centre(coords, centres, index=index, backend=backend)
        else:
            cells = locate_cell(coords, centres, child_offsets, child, depth=depth, backend=backend)
    check_range(op, "cells", cells, k)
    return cells


def first_rows(outputs: Sequence[Tensor], cells: Tensor, rows: Tensor | None) -> tuple[list[Tensor], Tensor]:
    """Outputs and cells of the first ``rows``, int32 [1] or None for all; the others are 0, and in no cell: -1."""
    if rows is None:
        return list(outputs), cells
    beyond = torch.arange(cells.shape[0], device=cells.device) >= rows
    return [out.masked_fill(beyond[:, None], 0) for out in outputs], cells.masked_fill(beyond, -1)


# A compiler that traces this finds only the implementations that are loaded before.
for _op in ("nearest_centre", "locate_cell", "cell_sort", "grouped_program"):
    backends.chosen(_op, torch.device("cpu"), torch.float32, backend="reference")
