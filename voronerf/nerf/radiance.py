"""Fields as programs, for the operations that take networks, colours and loss together. n samples, r rays."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.field import DirectionPerSample, Field
from voronerf.ops._core.program import VALUE, Builder, Columns, Program, Step, pruned
from voronerf.ops.forward_with_tape import forward_with_tape
from voronerf.router import VoronoiRouter
from voronerf.router.program import CellProgram

_THRESHOLD = 20.0  # from which on softplus is its argument; above that of float32, where both are the same


class Networks(NamedTuple):
    """A radiance field as a program.

    Attributes:
        program: Of positions [n, 3], or Gaussians [n, 6], and, if read, of directions [r, 3] with one row for each ray,
            to colour and density, one output [n, 4].
        density_scale: They come before the sigmoid of the colour and before the softplus of the density, which has this
            factor; None for what is the colour and the density already.
        density: Of positions alone, to the density [n, 1] itself; None if directions are read for it.
    """

    program: Program
    density_scale: float | None
    density: Program | None


class Radiance(NamedTuple):
    """A radiance field whose program is known, with its parameters and cells.

    Attributes:
        router: Whose networks they are.
        cells: What a call of it computes.
        networks: The same as a radiance field.
    """

    router: VoronoiRouter
    cells: CellProgram
    networks: Networks

    @property
    def rule(self) -> dict[str, Any]:
        """How `render_loss` shall read the outputs."""
        scale = self.networks.density_scale
        return {"activated": True} if scale is None else {"density_scale": scale}

    def arguments(self, inputs: Tensor, directions: Tensor, ray_index: Tensor) -> dict[str, Any]:
        """The arguments of `forward_with_tape` for samples; see :class:`voronerf.nerf.Field` and :class:`Networks`."""
        places, rays = self.router.places(inputs), self.networks.program.rays
        tensors = {"inputs": [inputs, directions], "ray_index": ray_index} if rays else {"inputs": [inputs]}
        return {"program": self.networks.program, "parameters": self.cells.parameters, **tensors, **places}

    def density(self, points: Tensor) -> Tensor | None:
        """[n], of points [n, 3], without the layers of the colour; None if it depends on the direction."""
        router, program = self.router, self.networks.density
        if program is None:
            return None
        network = {"program": program, "inputs": [points], "parameters": self.cells.parameters, **router.places(points)}
        return forward_with_tape(network, backend=router.backend).raw[:, 0]


def radiance_of(field: Field, samples: tuple[Tensor, Tensor] | None = None, *, inputs: int = 3) -> Radiance | str:
    """The program of a field; or the reason why it is unknown.

    Args:
        field: A router, or one in a `DirectionPerSample`.
        samples: Positions [n, 3] or Gaussians [n, 6], and directions [n, 3], on which a module that has not been is
            traced; None for no trace.
        inputs: Columns of the former.
    """
    router = router_of(field)
    if router is None:
        return f"the field is a {type(field).__name__}, no router"
    first = router.diagram.centres
    cells = router.program(*(samples or _example(inputs, first.device)), trace=samples is not None)
    if isinstance(cells, str):
        return cells
    networks = _networks(cells.program.text, cells.reads, cells.shapes, inputs)
    return networks if isinstance(networks, str) else Radiance(router, cells, networks)


def router_of(field: Field) -> VoronoiRouter | None:
    """The router that is a field, or whose network is given a direction for each sample; None if there is none."""
    inner = field.network if isinstance(field, DirectionPerSample) else field
    return inner if isinstance(inner, VoronoiRouter) else None


@functools.lru_cache(maxsize=8)
def _example(inputs: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Samples [2, inputs] and a direction for each of them."""
    return torch.zeros(2, inputs, device=device), torch.zeros(2, 3, device=device)


@functools.lru_cache(maxsize=256)
def _networks(text: str, reads: tuple[int, ...], shapes: tuple[tuple[int, ...], ...], inputs: int) -> Networks | str:
    """The networks of a `CellProgram`; or why it is no radiance field."""
    program = Program.parse(text)
    if len(shapes) != 2 or shapes[0] != (3,) or shapes[1] not in ((), (1,)):
        return (
            f"forward must return a colour [n, 3] and a density [n], got {' and '.join(map(str, shapes))} for a sample"
        )
    if 0 not in reads:
        return "the field does not depend on positions"
    if (width := program.inputs[reads.index(0)]) != inputs:
        return f"the field takes {width} numbers for a sample, and there are {inputs}"
    colour, density = program.outputs
    raw = _raw(program.steps, colour, density)
    before, scale = raw if raw is not None else ([colour, density], None)
    apart = _past_moves(program)
    alone = _of_fields(apart, [apart.outputs[1]], reads, inputs)
    return Networks(_of_fields(program, before, reads, inputs), scale, None if alone.rays else alone)


def _past_moves(program: Program) -> Program:
    """A program that reads columns at their source, not where they were put side by side: density without colour."""
    moves = {step.out: step for step in program.steps if step.op == "move"}

    def source(columns: Columns) -> Columns:
        step = moves.get(columns.index) if columns.of == VALUE and not columns.spread else None
        for at, part in zip(step.numbers, step.operands) if step is not None else ():
            if not part.spread and at <= columns.start and columns.start + columns.width <= at + part.width:
                return source(part.part(columns.start - int(at), columns.width))
        return columns

    steps = [step._replace(operands=tuple(map(source, step.operands))) for step in program.steps]
    return replace(program, steps=tuple(steps), outputs=tuple(map(source, program.outputs)))


def _of_fields(program: Program, outputs: Sequence[Columns], reads: tuple[int, ...], width: int) -> Program:
    """A program with positions as its first input, directions of rays as its second if read, and one output."""
    needed, b = pruned(Builder(program).program(outputs)), Builder()
    read = {int(step.numbers[0]) for step in needed.steps if step.op == "input"}
    arguments = [b.input(width)]
    if any(reads[number] == 1 for number in read):
        arguments.append(b.input(3, ray=True))
    values = b.replay(needed, {number: arguments[reads[number]] for number in read})
    return b.program([b.side_by_side(values)])


def _raw(steps: Sequence[Step], colour: Columns, density: Columns) -> tuple[list[Columns], float] | None:
    """Columns before a sigmoid and before a softplus, and the factor on that; None for other activations."""
    made = {step.out: step for step in steps}

    def before(columns: Columns, name: str) -> tuple[Columns, float, float] | None:
        step = made[columns.index] if columns.of == VALUE and not columns.spread else None
        if step is None or step.op != "function" or step.name != name or step.numbers[0] or len(step.operands) > 1:
            return None
        return step.operands[0].part(columns.start, columns.width), step.numbers[1], step.numbers[2]

    scale, of_colour = 1.0, before(colour, "sigmoid")
    scaled = before(density, "affine")
    if scaled is not None and scaled[2] == 0 and scaled[1] > 0:
        density, scale, _ = scaled
    of_density = before(density, "softplus")
    if of_colour is None or of_density is None or of_density[1] != 1 or of_density[2] < _THRESHOLD:
        return None
    return [of_colour[0], of_density[0]], scale
