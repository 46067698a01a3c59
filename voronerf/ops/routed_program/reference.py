"""Programs on samples in the cells of a diagram: find the cells, sort, run, and undo the sorting.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams, w columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.checks import check_range
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.grouped_program.arguments import ProgramArguments
from voronerf.ops.locate_cell import locate_cell
from voronerf.ops.nearest_centre import nearest_centre
from voronerf.ops.routed_program.routing import Routing


def routed_program(
    arguments: ProgramArguments, routing: Routing, backend: str = "reference"
) -> tuple[list[Tensor], Tensor]:
    """Returns outputs in the order of the samples, and the cells; see ``voronerf.ops.routed_program``.

    ``backend`` is the backend of the operations that it calls.
    """
    k, n, device = count_cells(arguments.parameters), arguments.inputs[0].shape[0], arguments.inputs[0].device
    cells, order = find_cells(arguments.caller, routing, k, backend), None
    if cells is None:
        cells = torch.zeros(n, dtype=torch.int32, device=device)
        offsets = torch.tensor([0, n], dtype=torch.int32, device=device)
    else:
        order, offsets = cell_sort(cells, k, backend=backend)
    return mask_rows(arguments.run(offsets, order, backend=backend), cells, routing.rows)


def count_cells(parameters: Sequence[Tensor]) -> int:
    """Returns the number of cells k of parameters [k, ...], or [1, ...] if all cells share them."""
    return next((p.shape[0] for p in parameters if p.shape[0] != 1), 1)


def find_cells(op: str, routing: Routing, k: int, backend: str) -> Tensor | None:
    """Returns int32 [n], the cells of samples, or None if there is one cell."""
    centres, child_offsets, child, depth, cells, coords, *_, index = routing
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


def mask_rows(outputs: Sequence[Tensor], cells: Tensor, rows: Tensor | None) -> tuple[list[Tensor], Tensor]:
    """Keeps the first ``rows`` rows (int32 [1]; None keeps all); later rows get outputs 0 and cell -1 (no cell)."""
    if rows is None:
        return list(outputs), cells
    beyond = torch.arange(cells.shape[0], device=cells.device) >= rows
    return [out.masked_fill(beyond[:, None], 0) for out in outputs], cells.masked_fill(beyond, -1)


# Loads the reference implementations, since torch.compile cannot load them while it traces.
for _op in ("nearest_centre", "locate_cell", "cell_sort", "grouped_program"):
    backends.chosen(_op, torch.device("cpu"), torch.float32, backend="reference")
