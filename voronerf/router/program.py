"""What a routed call computes, as one program: of a layer table, or of a module that was traced.

n samples, k cells, w columns.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.layers import MLP
from voronerf.ops._core.program import Builder, Program
from voronerf.ops._core.tolerances import agree
from voronerf.ops.grouped_program import grouped_program
from voronerf.router.double import Double
from voronerf.router.grouping import parts_of
from voronerf.router.layout import tensors_of
from voronerf.router.lower import Lowering, NotAStep
from voronerf.router.table import LayeredField, parameters_of_table
from voronerf.router.watch import Inputs, Watch

_ROWS = (37, 31)  # samples of a trace; one of them divides no width


class CellProgram(NamedTuple):
    """What a call computes, where that is one program.

    Attributes:
        program: Its outputs are the tensors that the call returns, in their order, [n, w] each.
        reads: Of each input of the program, the number of the argument of the call whose rows it is.
        shapes: Of each tensor that the call returns, for one sample.
        parameters: [k, ...], or without k where all cells share it: the module's own, or made of them.
        table: Gives the arguments of `routed_mlp` for the same parameters, of a field with a layer table.
        after: The steps from what the table puts out, one input, to the results; None without a table.
    """

    program: Program
    reads: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]
    parameters: list[Tensor]
    table: Callable[[], Mapping[str, Any]] | None = None
    after: Program | None = None


@dataclass(frozen=True)
class Activation:
    """The steps from what a layer table puts out to what its field returns."""

    function: Callable[..., Any]
    width: int
    watch: Watch  # of the attributes that the function reads
    program: Program | None = None  # of one input; None where they are more than steps
    shapes: tuple[tuple[int, ...], ...] = ()

    @staticmethod
    def of(field: LayeredField) -> Activation:
        """That of a field, from one call of its ``activate`` on a few samples."""
        width, parts = field.layers.out_features, list(parts_of(field).values())  # type: ignore[arg-type]
        reads = set[tuple[int, str]]()
        try:
            program, shapes = _steps_of(Double(parts[0], reads).module.activate, width)  # type: ignore[arg-type]
        except Exception:  # of any code: PyTorch computes it
            program, shapes = None, ()
        if any(name in parts[place]._parameters for place, name in reads):
            program = None
        return Activation(field.activate, width, Watch.of(parts[0], reads, Inputs()), program, shapes)

    def holds(self, field: LayeredField) -> bool:
        """Whether it is still that of a field."""
        same = field.activate == self.function and field.layers.out_features == self.width
        return same and not self.watch.changed()


def _steps_of(function: Callable[..., Any], width: int) -> tuple[Program, tuple[tuple[int, ...], ...]]:
    """A function of rows [n, width] as a program, and the shapes of its results for one row."""
    rows = next(rows for rows in _ROWS if width % rows)
    x = torch.linspace(-2, 2, rows * width).reshape(width, rows).t().contiguous()
    lowering = Lowering(rows)
    entries = lowering.input(None, x.shape, 0)
    result, _, entries_of = lowering.run(function, (x,), {}, lambda tensor: entries if tensor is x else None)
    made = [lowering.order(entries_of(tensor).codes)[1] for tensor in tensors_of(result)]
    program = lowering.builder.program([lowering.operand(numbers) for numbers in made])
    offsets = torch.tensor([0, rows], dtype=torch.int32)
    again = grouped_program([x], [], offsets, program=program, backend="reference")
    if not all(agree(a.reshape(b.shape), b) for a, b in zip(again, tensors_of(result), strict=True)):
        raise NotAStep("a function that gives something else as steps")
    return program, tuple(tuple(tensor.shape[1:]) for tensor in tensors_of(result))


def program_of_table(field: LayeredField, k: int, activation: Activation) -> CellProgram | str:
    """That of a field with a layer table; or why it is none."""
    layers, name = field.layers, type(field).__name__
    if activation.program is None:
        return f"activate of {name} computes more than steps of a program"
    linears, grid = field.linears(), layers.grid
    weights, biases = [layer.weight for layer in linears], [layer.bias for layer in linears]
    parameters = [*weights, *(bias for bias in biases if bias is not None)]
    parameters += [] if grid is None else [field.features]  # type: ignore[attr-defined]
    biased = tuple(bias is not None for bias in biases)
    program = _activated(layers.text, biased, activation.program.text)
    reads = (0, 1) if layers.uses_directions else (0,)
    table = functools.partial(parameters_of_table, field, k)
    return CellProgram(program, reads, activation.shapes, parameters, table, activation.program)


@functools.lru_cache(maxsize=64)
def _activated(text: str, biased: tuple[bool, ...], activation: str) -> Program:
    """The program of a layer table and the steps behind it, both by their texts."""
    layers, after = MLP.parse(text), Program.parse(activation)
    table = layers.program(6 if layers.integrated else 3, 3 if layers.uses_directions else 0, None, biased)
    b = Builder()
    inputs = {number: b.input(width) for number, width in enumerate(table.inputs)}
    return b.program(b.replay(after, {0: b.replay(table, inputs)[0]}))
