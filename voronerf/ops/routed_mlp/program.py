"""Programs on samples in the cells of a diagram: the checks, and the specification. n samples, r rays, k cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.program import Program
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.grouped_mlp.checks import PLACES, check_places, rows_of_places, with_coords
from voronerf.ops.grouped_program import check_program, grouped_program
from voronerf.ops.routed_mlp.reference import Where, find_cells, first_rows


def check_routed_program(
    op: str, /, program: Program, inputs: Sequence[Tensor], parameters: Sequence[Tensor], **given: Any
) -> dict[str, Any]:
    """Arguments of `routed_program` but for the backend, and ``frozen``, checked; what is compared has one dtype."""
    network = {**PLACES, "ray_index": None, **given}
    if len(network) > len(PLACES) + 1:
        raise TypeError(f"{op}: unknown arguments {', '.join(network.keys() - PLACES.keys() - {'ray_index'})}")
    known = isinstance(program, Program) and isinstance(parameters, Sequence)
    known = known and all(isinstance(p, Tensor) for p in parameters)
    shaped = with_cells(program, parameters) if known else parameters  # the others are refused
    sizes = check_program(op, program, inputs, shaped, network["ray_index"], last=rows_of_places(op, network))
    if len(program.outputs) != 1 or program.sums or program.by_ray or 0 in program.rays:
        raise ValueError(f"{op}: program must have one output [n, w] and inputs[0] [n, w], got others")
    check_places(op, network, sizes, program.inputs[0])
    return {"program": program, "inputs": inputs, "parameters": parameters, **with_coords(inputs[0], network)}


def with_cells(program: Program, parameters: Sequence[Tensor]) -> Sequence[Tensor]:
    """Parameters [1, ...] in the place of those that have no dimension of cells, since all cells share them."""
    shapes = program.parameters
    shaped = [p.unsqueeze(0) if p.dim() == len(shape) else p for p, shape in zip(parameters, shapes)]
    return [*shaped, *parameters[len(shapes) :]]


def cells_of(parameters: Sequence[Tensor]) -> int:
    """k, of parameters [k, ...] and those [1, ...] that all cells share."""
    return max([parameter.shape[0] for parameter in parameters], default=1)


def routed_program(
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    ray_index: Tensor | None = None,
    backend: str = "reference",
    **where: Any,
) -> tuple[Tensor, Tensor]:
    """A program on samples in any order, as ``routed_mlp`` runs a layer table.

    Args:
        program: with one output.
        inputs: as of ``grouped_program``; the first, [n, w], begins with the positions.
        parameters: as of ``grouped_program``, or without the dimension of cells where all cells share it.
        ray_index: int32 [n], where an input has one row for each ray.
        backend: that of the operations it is made of.
        **where: `Where`.

    Returns:
        The output [n, w] in the order of the samples, and cells int32 [n].
    """
    places, parameters = Where(**where), with_cells(program, parameters)
    k, n, device = cells_of(parameters), inputs[0].shape[0], inputs[0].device
    cells, order = find_cells(places, k, backend), None
    if cells is None:
        cells = torch.zeros(n, dtype=torch.int32, device=device)
        offsets = torch.tensor([0, n], dtype=torch.int32, device=device)
    else:
        order, offsets = cell_sort(cells, k, backend=backend)
    rest: dict[str, Any] = {"program": program, "order": order, "ray_index": ray_index, "backend": backend}
    (out,) = grouped_program(inputs, parameters, offsets, **rest)
    return first_rows(out, cells, places.rows)
