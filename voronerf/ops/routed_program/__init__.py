"""Programs on samples in the cells of a diagram. n samples, r rays, k cells, m centres of all diagrams together, g
diagrams, w columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops._core.program import Program
from voronerf.ops.grouped_mlp.checks import PLACES, check_places, rows_of_places, with_coords
from voronerf.ops.grouped_program import check_program
from voronerf.ops.routed_program.reference import with_cells

_OP = backends.declare("routed_program", native=Implementation(EVERYWHERE, FLOATS), warp=PLAIN)


def routed_program(
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    ray_index: Tensor | None = None,
    centres: Tensor | None = None,
    child_offsets: Tensor | None = None,
    child: Tensor | None = None,
    depth: int = 1,
    cells: Tensor | None = None,
    coords: Tensor | None = None,
    frozen: Tensor | None = None,
    rows: Tensor | None = None,
    backend: str = "auto",
) -> tuple[list[Tensor], Tensor]:
    """Runs a program on every sample with the parameters of the cell it lies in.

    Equivalent to ``locate_cell``, ``cell_sort`` and ``grouped_program`` with the order; results are in the order of the
    samples. Gradients of every order to inputs and parameters; none through the choice of the cell.

    Args:
        program: of outputs [n, w] alone, without sums; its first input has a row for each sample.
        inputs: as in ``grouped_program``; the first three columns of the first one locate the samples, unless
            ``coords`` do.
        parameters: as in ``grouped_program``; those that all cells share also without the dimension of cells.
        ray_index: as in ``grouped_program``.
        centres: as in ``routed_mlp``, and so the further arguments.
        child_offsets: int32 [g + 1], or None for a flat diagram.
        child: int32 [m], or None for a flat diagram.
        depth: levels of the tree.
        cells: int32 [n], the cell of each sample, 0 to k - 1, instead of the tables.
        coords: [n, 3], the locations of the samples.
        frozen: bool [k], the cells whose samples have no gradient to anything, or None.
        rows: int32 [1], how many of the samples count; None for all.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, w] for each output, in the dtype of the inputs (of autocast, where it is on); and cells int32 [n].

    Raises:
        ValueError: a program with sums, or of rays alone; what ``grouped_program`` and ``routed_mlp`` refuse.

    Examples:
        >>> import torch
        >>> from voronerf.ops import routed_program
        >>> from voronerf.ops._core.program import Builder
        >>> b = Builder()
        >>> program = b.program([b.linear(b.input(3), b.parameter(1, 3), 1)])  # W x
        >>> weights = torch.tensor([[[1.0, 0, 0]], [[100.0, 0, 0]]])
        >>> positions, centres = torch.tensor([[0.9, 0, 0], [0.1, 0, 0]]), torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
        >>> (out,), cells = routed_program(program, [positions], [weights], centres=centres)
        >>> out.flatten(), cells
        (tensor([90.0000,  0.1000]), tensor([1, 0], dtype=torch.int32))
    """
    network = check_routed_program(
        _OP,
        False,
        program,
        inputs,
        parameters,
        ray_index=ray_index,
        centres=centres,
        child_offsets=child_offsets,
        child=child,
        depth=depth,
        cells=cells,
        coords=coords,
        frozen=frozen,
        rows=rows,
    )
    run = backends.resolve_composed(_OP, backend=backend, device=inputs[0].device, dtype=inputs[0].dtype)
    frozen = network.pop("frozen")
    outputs, found = run(**network)
    if frozen is not None:
        held = of_samples(frozen, found)
        outputs = [hold(out, held) for out in outputs]
    return outputs, found


def check_routed_program(
    op: str, alone: bool, /, program: Program, inputs: Sequence[Tensor], parameters: Sequence[Tensor], **given: Any
) -> dict[str, Any]:
    """Arguments of `routed_program` but for the backend, checked; what is compared has one dtype. ``alone``: whether
    there may be one output alone."""
    network = {**PLACES, "ray_index": None, **given}
    if len(network) > len(PLACES) + 1:
        raise TypeError(f"{op}: unknown arguments {', '.join(network.keys() - PLACES.keys() - {'ray_index'})}")
    known = isinstance(program, Program) and isinstance(parameters, Sequence)
    known = known and all(isinstance(p, Tensor) for p in parameters)
    shaped = with_cells(program, parameters) if known else parameters  # the others are refused
    sizes = check_program(op, program, inputs, shaped, network["ray_index"], last=rows_of_places(op, network))
    several = alone and len(program.outputs) != 1
    if several or not program.outputs or program.sums or program.by_ray or 0 in program.rays:
        rule = "one output [n, w]" if alone else "outputs [n, w]"
        raise ValueError(f"{op}: program must have {rule} and inputs[0] [n, w], got others")
    check_places(op, network, sizes, program.inputs[0])
    return {"program": program, "inputs": inputs, "parameters": parameters, **with_coords(inputs[0], network)}


def of_samples(frozen: Tensor, cells: Tensor) -> Tensor:
    """bool [n, 1], whether the cell of each sample is frozen; a sample in no cell, -1, is as the first."""
    return frozen.index_select(0, cells.clamp(min=0))[:, None]


def hold(out: Tensor, rows: Tensor) -> Tensor:
    """The same values, with gradients of zero in rows bool [n, 1]; rows of zeros leave the backward pass of native."""
    return _Hold.apply(out, rows) if out.requires_grad else out


class _Hold(torch.autograd.Function):
    @staticmethod
    def forward(out: Tensor, rows: Tensor) -> Tensor:
        return out.view_as(out)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient.masked_fill(ctx.saved_tensors[0], 0), None
