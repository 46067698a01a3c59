"""Programs on samples in the cells of a diagram. n samples, r rays, k cells, m centres of all diagrams together, g
diagrams, w columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops._core.program import Program
from voronerf.ops.grouped_program import check_program
from voronerf.ops.grouped_program.given import Given
from voronerf.ops.routed_program.where import Where

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
    centre_index: Tensor | None = None,
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
        centre_index: what `index_centres` has made of the centres of a flat diagram, or None.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, w] for each output, in the dtype that ``grouped_program`` gives; and cells int32 [n].

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
    where = Where(centres, child_offsets, child, depth, cells, coords, rows, frozen, centre_index)
    routed = check_routed_program(_OP, False, program, inputs, parameters, ray_index, where)
    return run(routed.given(_OP), routed.where, backend=backend, op=_OP)


def run(given: Given, where: Where, *, backend: str, op: str = _OP) -> tuple[list[Tensor], Tensor]:
    """The outputs of a program on the samples of cells, in the order of the samples, and the cells."""
    device = given.inputs[0].device
    implementation = backends.resolve_composed(op, backend=backend, device=device, dtype=given.dtype)
    outputs, found = implementation(given, where)
    if where.frozen is not None:
        held = of_samples(where.frozen, found)
        outputs = [hold(out, held) for out in outputs]
    return outputs, found


class Routed(NamedTuple):
    """A program, its tensors as they were given, and what tells the cells, all of them checked."""

    program: Program
    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    where: Where

    def given(self, caller: str) -> Given:
        """The program and its tensors, parameters with a dimension of cells."""
        parameters = with_cells(self.program, self.parameters)
        return Given.of(caller, self.program.text, self.inputs, parameters, self.ray_index)


def routed_of(op: str, network: Mapping[str, Any]) -> Routed:
    """The arguments of `routed_program` by name, but for the backend, checked; of a program with one output."""
    places = {name: network[name] for name in Where._fields if name in network}
    rest = {name: given for name, given in network.items() if name not in places}
    if unknown := rest.keys() - {"program", "inputs", "parameters", "ray_index"}:
        raise TypeError(f"{op}: unknown arguments {', '.join(sorted(unknown))}")
    return check_routed_program(op, True, **{"ray_index": None, **rest, "where": Where(**places)})


def check_routed_program(
    op: str,
    alone: bool,
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    ray_index: Tensor | None,
    where: Where,
) -> Routed:
    """The arguments of `routed_program`, checked; ``alone``: whether there may be one output alone."""
    known = isinstance(program, Program) and isinstance(parameters, Sequence)
    known = known and all(isinstance(p, Tensor) for p in parameters)
    shaped = with_cells(program, parameters) if known else parameters  # the others are refused
    sizes = check_program(op, program, inputs, shaped, ray_index, last=where.to_check(op))
    several = alone and len(program.outputs) != 1
    if several or not program.outputs or program.sums or program.by_ray or 0 in program.rays:
        rule = "one output [n, w]" if alone else "outputs [n, w]"
        raise ValueError(f"{op}: program must have {rule} and inputs[0] [n, w], got others")
    return Routed(program, inputs, parameters, ray_index, where.at(op, inputs[0], sizes))


def with_cells(program: Program, parameters: Sequence[Tensor]) -> Sequence[Tensor]:
    """Parameters [1, ...] in the place of those that have no dimension of cells, since all cells share them."""
    shapes = program.parameters
    shaped = [p.unsqueeze(0) if p.dim() == len(shape) else p for p, shape in zip(parameters, shapes)]
    return [*shaped, *parameters[len(shapes) :]]


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
