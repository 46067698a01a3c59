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
from voronerf.ops.grouped_program.arguments import ProgramArguments
from voronerf.ops.routed_program.routing import Routing

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

    Equivalent to ``locate_cell``, ``cell_sort`` and ``grouped_program`` with the order of the samples. Results are in
    the order of the samples. Inputs and parameters have gradients of every order; the choice of the cell has none.

    Args:
        program: a program with outputs [n, w] only, without sums; its first input has a row for each sample.
        inputs: the inputs as in ``grouped_program``; the first three columns of the first input locate the samples,
            unless ``coords`` is given.
        parameters: the parameters as in ``grouped_program``; parameters that all cells share may lack the dimension of
            cells.
        ray_index: int32 [n], the ray of each sample as in ``grouped_program``; None without inputs of rays.
        centres: the centres of the tree. This argument and the following ones are as in ``routed_mlp``.
        child_offsets: int32 [g + 1], or None for a flat diagram.
        child: int32 [m], or None for a flat diagram.
        depth: the number of levels of the tree.
        cells: int32 [n], the cell of each sample, 0 to k - 1; given instead of ``centres``, ``child_offsets`` and
            ``child``.
        coords: [n, 3], the locations of the samples.
        frozen: bool [k], the frozen cells, whose samples have no gradients; or None.
        rows: int32 [1], the number of valid leading samples; None for all.
        centre_index: the index of the centres of a flat diagram by `index_centres`, or None.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, w] for each output, in the dtype that ``grouped_program`` would return; and cells int32 [n].

    Raises:
        ValueError: the program has sums, or its first input has one row for each ray; or ``grouped_program`` or
            ``routed_mlp`` would refuse the arguments.

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
    routing = Routing(centres, child_offsets, child, depth, cells, coords, rows, frozen, centre_index)
    routed = check_routed_program(_OP, False, program, inputs, parameters, ray_index, routing)
    return run(routed.arguments(_OP), routed.routing, backend=backend, op=_OP)


def run(arguments: ProgramArguments, routing: Routing, *, backend: str, op: str = _OP) -> tuple[list[Tensor], Tensor]:
    """Runs a checked program on samples; returns outputs and cells, in the order of the samples."""
    device = arguments.inputs[0].device
    implementation = backends.resolve_composed(op, backend=backend, device=device, dtype=arguments.dtype)
    outputs, cells = implementation(arguments, routing)
    if routing.frozen is not None:
        held = frozen_rows(routing.frozen, cells)
        outputs = [stop_gradients(out, held) for out in outputs]
    return outputs, cells


class Routed(NamedTuple):
    """The checked arguments of `routed_program`."""

    program: Program
    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    routing: Routing

    def arguments(self, caller: str) -> ProgramArguments:
        """Returns the program and its tensors; parameters get a dimension of cells if they lack it."""
        parameters = with_cells(self.program, self.parameters)
        return ProgramArguments.of(caller, self.program.text, self.inputs, parameters, self.ray_index)


def check_network(op: str, network: Mapping[str, Any]) -> Routed:
    """Checks arguments of `routed_program`, by name and without ``backend``; the program must have one output."""
    routing = {name: network[name] for name in Routing._fields if name in network}
    rest = {name: value for name, value in network.items() if name not in routing}
    if unknown := rest.keys() - {"program", "inputs", "parameters", "ray_index"}:
        raise TypeError(f"{op}: unknown arguments {', '.join(sorted(unknown))}")
    return check_routed_program(op, True, **{"ray_index": None, **rest, "routing": Routing(**routing)})


def check_routed_program(
    op: str,
    alone: bool,
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    ray_index: Tensor | None,
    routing: Routing,
) -> Routed:
    """Checks the arguments of `routed_program`; ``alone``: whether the program must have exactly one output."""
    valid = isinstance(program, Program) and isinstance(parameters, Sequence)
    valid = valid and all(isinstance(p, Tensor) for p in parameters)
    shaped = with_cells(program, parameters) if valid else parameters  # `check_program` refuses other types
    sizes = check_program(op, program, inputs, shaped, ray_index, last=routing.to_check(op))
    several = alone and len(program.outputs) != 1
    if several or not program.outputs or program.sums or program.by_ray or 0 in program.rays:
        rule = "one output [n, w]" if alone else "outputs [n, w]"
        raise ValueError(f"{op}: program must have {rule}, and inputs[0] with one row for each sample")
    return Routed(program, inputs, parameters, ray_index, routing.at(op, inputs[0], sizes))


def with_cells(program: Program, parameters: Sequence[Tensor]) -> Sequence[Tensor]:
    """Returns the parameters, with shape [1, ...] for shared parameters without a dimension of cells."""
    shapes = program.parameters
    shaped = [p.unsqueeze(0) if p.dim() == len(shape) else p for p, shape in zip(parameters, shapes)]
    return [*shaped, *parameters[len(shapes) :]]


def frozen_rows(frozen: Tensor, cells: Tensor) -> Tensor:
    """Returns bool [n, 1], whether each sample's cell is frozen; a sample in no cell (-1) counts as in cell 0."""
    return frozen.index_select(0, cells.clamp(min=0))[:, None]


def stop_gradients(out: Tensor, rows: Tensor) -> Tensor:
    """Returns ``out`` with zero gradients in ``rows``, bool [n, 1]; the native backward pass drops these rows."""
    return _StopGradients.apply(out, rows) if out.requires_grad else out


class _StopGradients(torch.autograd.Function):
    @staticmethod
    def forward(out: Tensor, rows: Tensor) -> Tensor:
        return out.view_as(out)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient.masked_fill(ctx.saved_tensors[0], 0), None
