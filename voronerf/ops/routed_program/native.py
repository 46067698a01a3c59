"""The fused route of the compiled module: locate and sort in one op, then a program on the rows where they are.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams. The rows of a tile are gathered from where
the samples lie and its results written to where they belong, so that nothing but the order (int32) has n rows beside
inputs and outputs. On CUDA these are launches one after another on the current stream, and nothing is read on the host.
Shapes and dtypes have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.checks import check_same_device, of_one_dtype
from voronerf.ops._core.custom_op import custom_op, is_watched
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.cell_sort.native import sort
from voronerf.ops.grouped_program.given import Given
from voronerf.ops.grouped_program.native import How, Network, Rows, run_program
from voronerf.ops.locate_cell.native import find as find_leaves
from voronerf.ops.nearest_centre import nearest_centre
from voronerf.ops.nearest_centre.native import find as find_nearest
from voronerf.ops.routed_program import hold, of_samples
from voronerf.ops.routed_program.reference import cells_of, first_rows
from voronerf.ops.routed_program.where import Where


def routed_program(given: Given, where: Where) -> tuple[list[Tensor], Tensor]:
    """Outputs in the order of the samples, and the cells; see ``voronerf.ops.routed_program``."""
    network, where = Network.of(given), of_cells(where, cells_of(given.parameters))
    route = find(network.inputs[0], where, cells_of(given.parameters), given.caller)
    outputs = network.run(route.offsets, route.order)
    if where.rows is None or native.on_cuda(route.offsets):  # CUDA has left out the others
        return outputs, route.cells
    return first_rows(outputs, route.cells, where.rows)


def of_cells(where: Where, k: int) -> Where:
    """The same, without tables for one cell, and on CUDA with -1 for samples that do not count."""
    cells, rows = where.cells, where.rows
    if rows is not None and cells is not None and native.on_cuda(cells):
        return where._replace(cells=torch.where(torch.arange(cells.shape[0], device=cells.device) < rows, cells, -1))
    return Where(depth=where.depth, rows=rows) if cells is None and k == 1 else where


def run_known(
    how: How, inputs: Sequence[Tensor], parameters: Sequence[Tensor], k: int, *, frozen: Tensor | None, **places: Any
) -> list[Tensor]:
    """The outputs for float32 inputs and parameters [k, ...] or [1, ...] that a router has checked before."""
    first, centres = inputs[0], places.get("centres")
    if centres is not None and "child" not in places and centres.is_cpu and not _is_seen(first):
        cells, order, offsets = _in_two_calls(places["coords"], centres, places.get("centre_index"), k)
    elif "cells" in places and not _is_seen(first):
        cells = places["cells"]
        order, offsets = cell_sort(cells, k, backend="native")
    else:
        if centres is not None and centres.device != first.device:
            check_same_device("VoronoiRouter", samples=first, centres=centres)
        where = Where(**places)
        if where.coords is not None and centres is not None:
            coords, centres = of_one_dtype(where.coords, centres)
            where = where._replace(
                coords=coords, centres=centres, centre_index=where.centre_index if centres is where.centres else None
            )
        cells, order, offsets = find(first, of_cells(where, k), k, how.caller)
    outputs = run_program(Rows(inputs, parameters, offsets, order, None), how)
    if frozen is not None:
        rows = of_samples(frozen, cells)
        outputs = [hold(out, rows) for out in outputs]
    return outputs


class Route(NamedTuple):
    """Where samples are: cells int32 [n], the order int32 [n] that sorts them or None, and offsets int32 [k + 1]."""

    cells: Tensor
    order: Tensor | None
    offsets: Tensor


def find(positions: Tensor, where: Where, k: int, caller: str) -> Route:
    """The cells of samples, and their order by cell; None where there is one cell. ``caller``: the op of errors."""
    centres, child_offsets, child, depth, known, coords, rows, _, index = where
    if coords is not None and centres is not None and child is None and rows is None and not _is_seen(positions):
        return _in_two_calls(coords, centres, index, k)
    if coords is not None and coords.requires_grad:
        coords = coords.detach()
    if positions.requires_grad:
        positions = positions.detach()
    places = centres, child_offsets, child, depth, known, coords, rows, index
    cells, order, offsets = locate_and_sort(positions, *places, k, caller)
    return Route(cells if known is None else known, order if order.numel() else None, offsets)


def _is_seen(positions: Tensor) -> bool:
    """Whether torch has to see where samples are, or they are on a GPU."""
    return not positions.is_cpu or torch.compiler.is_compiling() or is_watched()


def _in_two_calls(coords: Tensor, centres: Tensor, index: Tensor | None, k: int) -> Route:
    """Cells of a flat diagram: calls that the compiled module makes by itself take less time than one op in Python."""
    index = index if coords.dtype is centres.dtype else None
    cells = nearest_centre(coords, centres, index=index, backend="native")
    order, offsets = cell_sort(cells, k, backend="native")
    return Route(cells, order if order.numel() else None, offsets)


class _Samples(NamedTuple):
    """Samples, the members of `Where`, the number of cells, and the op that errors name."""

    positions: Tensor
    centres: Tensor | None
    child_offsets: Tensor | None
    child: Tensor | None
    depth: int
    cells: Tensor | None
    coords: Tensor | None
    rows: Tensor | None
    centre_index: Tensor | None
    k: int
    caller: str


def _memory(given: _Samples) -> tuple[Tensor, Tensor, Tensor]:
    """Cells (empty where they are given), the order (empty where there is one cell) and offsets."""
    n, alone = rows_of(given.positions), given.cells is None and given.centres is None
    cells = new_empty(given.positions, n if given.cells is None else 0, dtype=torch.int32)
    order = new_empty(cells, 0 if alone else n)
    return cells, order, new_empty(cells, given.k + 1)


@custom_op("routed_program_native", _memory)
def locate_and_sort(given: _Samples, results: tuple[Tensor, Tensor, Tensor]) -> None:
    """Where samples are, and their order by cell."""
    positions, centres, child_offsets, child, depth, cells, coords, rows, index, _, caller = given
    found, order, offsets = results
    if cells is None and centres is None:  # one cell
        n = rows_of(positions)
        if not native.on_cuda(positions):
            native.compiled.one_cell(found, offsets, n, native.cpu())
        elif rows is None:
            found.zero_()
            offsets[0], offsets[1] = 0, n
        else:
            found.copy_(torch.where(torch.arange(n, device=found.device) < rows, 0, -1))
            offsets[:1].zero_()
            offsets[1:].copy_(rows)
        return
    if coords is not None and centres is not None:
        if child_offsets is None or child is None:
            find_nearest(found, coords, centres, rows, index)
        else:
            find_leaves(found, coords, centres, (child_offsets, child, depth), caller, rows)
    sort(found if cells is None else cells, order, offsets, caller)


def _setup(ctx: Any, inputs: Any, output: tuple[Tensor, ...]) -> None:
    ctx.mark_non_differentiable(*output)


def _nothing(ctx: Any, *gradients: None) -> tuple[Any, ...]:
    return (None,) * len(_Samples._fields)


locate_and_sort.register_autograd(_nothing, setup_context=_setup)  # integers, which torch.func asks for all the same
