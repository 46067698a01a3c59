"""``routed_program`` of the compiled module: one op locates and sorts samples, then the program reads them in place.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams. The tiles of the program gather their rows
from the unsorted samples and scatter their results back, so only the order (int32) needs memory for n rows besides
inputs and outputs. On CUDA the op and the program are launched on the current stream, and the host reads no values.
``voronerf.ops`` has validated shapes and dtypes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.checks import check_same_device, to_common_dtype
from voronerf.ops._core.custom_op import custom_op, has_listeners
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.cell_sort.native import sort
from voronerf.ops.grouped_program.arguments import ProgramArguments
from voronerf.ops.grouped_program.native import Network, RunOptions, RunTensors, run_program
from voronerf.ops.locate_cell.native import find as find_leaves
from voronerf.ops.nearest_centre import nearest_centre
from voronerf.ops.nearest_centre.native import find as find_nearest
from voronerf.ops.routed_program import frozen_rows, stop_gradients
from voronerf.ops.routed_program.reference import count_cells, mask_rows
from voronerf.ops.routed_program.routing import Routing


def routed_program(arguments: ProgramArguments, routing: Routing) -> tuple[list[Tensor], Tensor]:
    """Returns outputs in the order of the samples, and the cells; see ``voronerf.ops.routed_program``."""
    network, routing = Network.of(arguments), normalise_routing(routing, count_cells(arguments.parameters))
    route = find(network.inputs[0], routing, count_cells(arguments.parameters), arguments.caller)
    outputs = network.run(route.offsets, route.order)
    if routing.rows is None or native.on_cuda(route.offsets):  # on CUDA, invalid samples have no cell
        return outputs, route.cells
    return mask_rows(outputs, route.cells, routing.rows)


def normalise_routing(routing: Routing, k: int) -> Routing:
    """Returns the routing, without centres if there is one cell.

    On CUDA, if the caller gives cells, the cells of the samples after the first ``rows`` become -1 (no cell).
    """
    cells, rows = routing.cells, routing.rows
    if rows is not None and cells is not None and native.on_cuda(cells):
        return routing._replace(cells=torch.where(torch.arange(cells.shape[0], device=cells.device) < rows, cells, -1))
    return Routing(depth=routing.depth, rows=rows) if cells is None and k == 1 else routing


def run_checked(
    options: RunOptions,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    k: int,
    *,
    frozen: Tensor | None,
    **places: Any,
) -> list[Tensor]:
    """Returns the outputs for float32 inputs and parameters [k, ...] or [1, ...], which the router has checked.

    Args:
        options: the options with which the program runs.
        inputs: the inputs of the program.
        parameters: the parameters of the program.
        k: the number of cells.
        frozen: bool [k], the frozen cells, or None.
        places: the arguments of `Routing` that the router gives, by name.
    """
    first, centres = inputs[0], places.get("centres")
    if centres is not None and "child" not in places and centres.is_cpu and not _is_observed(first):
        cells, order, offsets = _in_two_calls(places["coords"], centres, places.get("centre_index"), k)
    elif "cells" in places and not _is_observed(first):
        cells = places["cells"]
        order, offsets = cell_sort(cells, k, backend="native")
    else:
        if centres is not None and centres.device != first.device:
            check_same_device("VoronoiRouter", samples=first, centres=centres)
        routing = Routing(**places)
        if routing.coords is not None and centres is not None:
            coords, centres = to_common_dtype(routing.coords, centres)
            routing = routing._replace(
                coords=coords,
                centres=centres,
                centre_index=routing.centre_index if centres is routing.centres else None,
            )
        cells, order, offsets = find(first, normalise_routing(routing, k), k, options.caller)
    outputs = run_program(RunTensors(inputs, parameters, offsets, order, None), options)
    if frozen is not None:
        rows = frozen_rows(frozen, cells)
        outputs = [stop_gradients(out, rows) for out in outputs]
    return outputs


class Route(NamedTuple):
    """The route of samples: cells int32 [n], the order int32 [n] that sorts them (or None), offsets int32 [k + 1]."""

    cells: Tensor
    order: Tensor | None
    offsets: Tensor


def find(positions: Tensor, routing: Routing, k: int, caller: str) -> Route:
    """Returns the cells of samples, and their order by cell, which is None if there is one cell.

    ``caller`` is the name of the op for error messages.
    """
    centres, child_offsets, child, depth, given_cells, coords, rows, _, index = routing
    if coords is not None and centres is not None and child is None and rows is None and not _is_observed(positions):
        return _in_two_calls(coords, centres, index, k)
    if coords is not None and coords.requires_grad:
        coords = coords.detach()
    if positions.requires_grad:
        positions = positions.detach()
    places = centres, child_offsets, child, depth, given_cells, coords, rows, index
    cells, order, offsets = locate_and_sort(positions, *places, k, caller)
    return Route(cells if given_cells is None else given_cells, order if order.numel() else None, offsets)


def _is_observed(positions: Tensor) -> bool:
    """Returns whether torch must observe the lookup of the cells, or the samples are on a GPU."""
    return not positions.is_cpu or torch.compiler.is_compiling() or has_listeners()


def _in_two_calls(coords: Tensor, centres: Tensor, index: Tensor | None, k: int) -> Route:
    """Returns the route in a flat diagram, by two calls of the compiled module, which are faster than one Python op."""
    index = index if coords.dtype is centres.dtype else None
    cells = nearest_centre(coords, centres, index=index, backend="native")
    order, offsets = cell_sort(cells, k, backend="native")
    return Route(cells, order if order.numel() else None, offsets)


class _Samples(NamedTuple):
    """The samples, the fields of `Routing`, the number of cells, and the name of the op for error messages."""

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


def _memory(arguments: _Samples) -> tuple[Tensor, Tensor, Tensor]:
    """Allocates cells (an empty tensor if the caller passes cells), order (empty for one cell) and offsets."""
    n, alone = rows_of(arguments.positions), arguments.cells is None and arguments.centres is None
    cells = new_empty(arguments.positions, n if arguments.cells is None else 0, dtype=torch.int32)
    order = new_empty(cells, 0 if alone else n)
    return cells, order, new_empty(cells, arguments.k + 1)


@custom_op("routed_program_native", _memory)
def locate_and_sort(arguments: _Samples, results: tuple[Tensor, Tensor, Tensor]) -> None:
    """Writes the cells of samples, their order by cell and the offsets."""
    positions, centres, child_offsets, child, depth, cells, coords, rows, index, _, caller = arguments
    new_cells, order, offsets = results
    if cells is None and centres is None:  # one cell
        n = rows_of(positions)
        if not native.on_cuda(positions):
            native.compiled.one_cell(new_cells, offsets, n, native.cpu())
        elif rows is None:
            new_cells.zero_()
            offsets[0], offsets[1] = 0, n
        else:
            new_cells.copy_(torch.where(torch.arange(n, device=new_cells.device) < rows, 0, -1))
            offsets[:1].zero_()
            offsets[1:].copy_(rows)
        return
    if coords is not None and centres is not None:
        if child_offsets is None or child is None:
            find_nearest(new_cells, coords, centres, rows, index)
        else:
            find_leaves(new_cells, coords, centres, (child_offsets, child, depth), caller, rows)
    sort(new_cells if cells is None else cells, order, offsets, caller)


def _setup(ctx: Any, inputs: Any, output: tuple[Tensor, ...]) -> None:
    ctx.mark_non_differentiable(*output)


def _nothing(ctx: Any, *gradients: None) -> tuple[Any, ...]:
    return (None,) * len(_Samples._fields)


locate_and_sort.register_autograd(_nothing, setup_context=_setup)  # torch.func needs one for integers, too
