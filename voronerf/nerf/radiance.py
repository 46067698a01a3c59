"""Fields as programs, for the ops that fuse networks, colours and loss. n samples, r rays."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from voronerf.nerf.field import DirectionPerSample, Field
from voronerf.ops._core.program import VALUE, Builder, Columns, Program, Step, pruned
from voronerf.ops.network import Network
from voronerf.router import VoronoiRouter
from voronerf.router.program import CellProgram

_THRESHOLD = 20.0  # the least supported threshold of softplus; in float32 softplus(x) == x above it


class Networks(NamedTuple):
    """A radiance field as a program.

    Attributes:
        program: The program from positions [n, 3], or Gaussians [n, 6], and, if used, directions [r, 3] of the rays, to
            one output [n, 4] of colour and density.
        raw: The same program without the sigmoid of the colour and the softplus of the density, which `render_loss`
            computes faster; or ``program``, if it has other activations.
        activation: The options that tell `render_loss` how to read the outputs of ``raw``.
        density: The program from positions to the density [n, 1]; None if it uses directions.
    """

    program: Program
    raw: Program
    activation: dict[str, Any]
    density: Program | None


class Radiance(NamedTuple):
    """A radiance field whose program is known, with its parameters and cells.

    Attributes:
        router: The router of the networks.
        cells: The program of the module's ``forward``, as the router runs it, and the parameters of all cells.
        networks: The programs that compute the same values, but have the inputs and outputs of a radiance field.
    """

    router: VoronoiRouter
    cells: CellProgram
    networks: Networks

    def network(self, program: Program) -> Network:
        """Returns a callable network: one of the programs of `Networks` with the parameters of all cells."""
        return Network(program, self.cells.parameters)

    def rows(self, inputs: Tensor, directions: Tensor, ray_index: Tensor) -> dict[str, Any]:
        """Returns the arguments, by name, with which the result of :meth:`network` evaluates samples."""
        cells = self.router.places(inputs)
        if self.networks.program.rays:
            return {"inputs": [inputs, directions], "cells": cells, "ray_index": ray_index}
        return {"inputs": [inputs], "cells": cells}

    def density(self, points: Tensor) -> Tensor | None:
        """Returns the density [n] of points [n, 3] without evaluating colours; None if it depends on the direction."""
        router, program = self.router, self.networks.density
        if program is None:
            return None
        with torch.no_grad():
            (density,), _ = self.network(program)([points], router.places(points), backend=router.backend)
        return density[:, 0].float()

    def note_dependencies(self, noted: Any) -> list[VoronoiRouter]:
        """Notes for a recorded step that it is valid only for the same programs and parameters; returns the router."""
        noted.answer(self._is_current)
        return [self.router]

    def _is_current(self) -> bool:
        current = radiance_of(self.router, inputs=self.networks.program.inputs[0])
        same = isinstance(current, Radiance) and current.networks is self.networks
        return same and all(map(operator.is_, cast(Radiance, current).cells.parameters, self.cells.parameters))


def radiance_of(field: Field, samples: tuple[Tensor, Tensor] | None = None, *, inputs: int = 3) -> Radiance | str:
    """Returns the program of a field, or the reason why it is unknown.

    Args:
        field: A router, or a router in a `DirectionPerSample`.
        samples: Positions [n, 3] or Gaussians [n, 6], and directions [n, 3], with which an untraced module is traced;
            None to trace nothing.
        inputs: The number of columns of positions or Gaussians.
    """
    router = router_of(field)
    if router is None:
        return f"the field is a {type(field).__name__}, not a VoronoiRouter"
    first = router.diagram.centres
    cells = router.program(*(samples or _example(inputs, first.device)), trace=samples is not None)
    if isinstance(cells, str):
        return cells
    networks = _networks(cells.program.text, cells.reads, cells.shapes, inputs)
    return networks if isinstance(networks, str) else Radiance(router, cells, networks)


def router_of(field: Field) -> VoronoiRouter | None:
    """Returns the field, or the network that a `DirectionPerSample` wraps, if it is a router; else None."""
    inner = field.network if isinstance(field, DirectionPerSample) else field
    return inner if isinstance(inner, VoronoiRouter) else None


@functools.lru_cache(maxsize=8)
def _example(inputs: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Returns example samples [2, inputs] and directions [2, 3]."""
    samples = torch.zeros(2, inputs, dtype=torch.float32, device=device)
    return samples, samples.new_zeros(2, 3)


@functools.lru_cache(maxsize=256)
def _networks(text: str, reads: tuple[int, ...], shapes: tuple[tuple[int, ...], ...], inputs: int) -> Networks | str:
    """Returns the networks of a `CellProgram`, or the reason why it is no radiance field.

    Args:
        text: The text of the program.
        reads: The attribute ``reads`` of the `CellProgram`.
        shapes: The attribute ``shapes`` of the `CellProgram`.
        inputs: The number of columns of positions or Gaussians.
    """
    program = Program.parse(text)
    if len(shapes) != 2 or shapes[0] != (3,) or shapes[1] not in ((), (1,)):
        return (
            f"forward must return a colour [n, 3] and a density [n], got {' and '.join(map(str, shapes))} for a sample"
        )
    if 0 not in reads:
        return "the field does not depend on positions"
    if (width := program.inputs[reads.index(0)]) != inputs:
        return f"the field takes {width} numbers per sample, got {inputs}"
    colour, density = program.outputs
    outputs = [colour, density]
    raw, activation = _before_activations(program.steps, *outputs) or (outputs, {"activated": True})
    direct = _without_moves(program)
    density_program = _field_program(direct, [direct.outputs[1]], reads, inputs)
    return Networks(
        _field_program(program, outputs, reads, inputs),
        _field_program(program, raw, reads, inputs),
        activation,
        None if density_program.rays else density_program,
    )


def _without_moves(program: Program) -> Program:
    """Bypasses the "move" operations of a program: other operations and outputs read the columns that a "move" copies.

    A "move" may join colour and density in one value. A program that read the density from this value would compute
    the colour too.
    """
    moves = {step.out: step for step in program.steps if step.op == "move"}

    def source(columns: Columns) -> Columns:
        step = moves.get(columns.index) if columns.of == VALUE and not columns.spread else None
        for at, part in zip(step.numbers, step.operands) if step is not None else ():
            if not part.spread and at <= columns.start and columns.start + columns.width <= at + part.width:
                return source(part.part(columns.start - int(at), columns.width))
        return columns

    steps = [step._replace(operands=tuple(map(source, step.operands))) for step in program.steps]
    return replace(program, steps=tuple(steps), outputs=tuple(map(source, program.outputs)))


def _field_program(program: Program, outputs: Sequence[Columns], reads: tuple[int, ...], width: int) -> Program:
    """Returns a program that maps positions and, if used, the directions of rays to one output."""
    needed, b = pruned(Builder(program).program(outputs)), Builder()
    read = {int(step.numbers[0]) for step in needed.steps if step.op == "input"}
    arguments = [b.input(width)]
    if any(reads[number] == 1 for number in read):
        arguments.append(b.input(3, ray=True))
    values = b.replay(needed, {number: arguments[reads[number]] for number in read})
    return b.program([b.side_by_side(values)])


def _before_activations(
    steps: Sequence[Step], colour: Columns, density: Columns
) -> tuple[list[Columns], dict[str, Any]] | None:
    """Returns the columns before sigmoid and softplus, and the options of the loss; None for other activations."""
    steps_by_output = {step.out: step for step in steps}

    def before(columns: Columns, name: str) -> tuple[Columns, float, float] | None:
        step = steps_by_output[columns.index] if columns.of == VALUE and not columns.spread else None
        if step is None or step.op != "function" or step.name != name or step.numbers[0] or len(step.operands) > 1:
            return None
        return step.operands[0].part(columns.start, columns.width), step.numbers[1], step.numbers[2]

    scale, raw_colour = 1.0, before(colour, "sigmoid")
    scaled = before(density, "affine")
    if scaled is not None and scaled[2] == 0 and scaled[1] > 0:
        density, scale, _ = scaled
    raw_density = before(density, "softplus")
    if raw_colour is None or raw_density is None or raw_density[1] != 1 or raw_density[2] < _THRESHOLD:
        return None
    return [raw_colour[0], raw_density[0]], {"density_scale": scale}
