"""Runs programs that are chains of layers: the layers in one Warp kernel, the steps after them in plain PyTorch.

n rows, w columns. All other programs run in plain PyTorch.
"""

from __future__ import annotations

import functools
from collections import Counter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.kernels.grouped_mlp import layers_of_cells
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import (
    ACTIVATIONS,
    DIRECTION_ENCODINGS,
    DIRECTIONS,
    MLP,
    NUMBERS,
    POSITION_ENCODINGS,
    POSITIONS,
    Layer,
)
from voronerf.ops._core.program import HASH, VALUE, Builder, Columns, Program, Step
from voronerf.ops.network.arguments import Arguments
from voronerf.ops.network.reference import check_rows, evaluate_rows
from voronerf.ops.network.reference import network as in_torch


class Chain(NamedTuple):
    """A program split into a layer table and a second program, made of the steps that follow the layers.

    Attributes:
        layers: the table; its outputs are the layers that the second program reads or returns.
        reads: the indices of the inputs that the table reads: positions, then directions.
        weights: the index of each layer's weight among the program's parameters.
        biases: the index of each layer's bias, or None.
        features: the index of the hash grid's table, or None.
        behind: the second program; its single input is the concatenated outputs of the table.
    """

    layers: MLP
    reads: tuple[int, ...]
    weights: tuple[int, ...]
    biases: tuple[int | None, ...]
    features: int | None
    behind: Program


def network(arguments: Arguments, offsets: Tensor, order: Tensor | None) -> list[Tensor]:
    """Runs a program on the rows of each cell; see ``voronerf.ops.network.Network``."""
    program, inputs, parameters, ray_index, dtype, *_ = arguments
    chain, k = chain_of(program.text), offsets.shape[0] - 1
    if chain is None:
        return in_torch(arguments, offsets, order)
    check_rows(arguments, offsets, order)
    with torch.autocast(inputs[0].device.type, enabled=False):
        rays = program.rays
        if order is not None:
            inputs = [x if i in rays else x.index_select(0, order) for i, x in enumerate(inputs)]
            ray_index = None if ray_index is None else ray_index.index_select(0, order)
        row = torch.arange(len(inputs[0]), device=offsets.device)
        inside = ((row >= offsets[0]) & (row < offsets[-1]))[:, None]
        inputs = [x if i in rays else torch.where(inside, x, 0) for i, x in enumerate(inputs)]
        features = None if chain.features is None else parameters[chain.features]
        if features is not None and features.shape[0] == 1:  # a table that all cells share
            features = features[0]
        raw = layers_of_cells(
            [inputs[i] for i in chain.reads],
            offsets,
            [parameters[i].expand(k, -1, -1) for i in chain.weights],
            [None if i is None else parameters[i].expand(k, -1) for i in chain.biases],
            chain.layers,
            ray_index,
            features,
            dtype,
        )
        results = [torch.where(inside, result, 0).to(dtype) for result in evaluate_rows([raw], chain.behind)]
        if order is None:
            return results
        return [torch.zeros_like(result).index_copy(0, order.long(), result) for result in results]


@constant_result  # around the cached function, which torch.compile would trace
def chain_of(text: str) -> Chain | None:
    """Returns the chain of a program's text, or None if the program is no chain."""
    return _chain_of(text)


@functools.lru_cache(maxsize=256)
def _chain_of(text: str) -> Chain | None:
    program = Program.parse(text)
    try:
        is_plain = not (program.sums or program.by_ray or 0 in program.rays)
        return _Reader(program).chain() if is_plain else None
    except LookupError:
        return None


_INPUTS = POSITIONS, DIRECTIONS


class _Layer(NamedTuple):
    """A layer under construction, from the steps read so far."""

    weight: int
    bias: int | None = None
    inputs: tuple[int | str, ...] = ()
    depth: int = 0


class _Reader:
    """A converter of a program's steps to a layer table; it raises LookupError if the steps are no chain."""

    def __init__(self, program: Program) -> None:
        self.program, self.steps = program, {step.out: step for step in program.steps}
        operands = [c for step in program.steps for c in step.operands]
        self.read = Counter(c.index for c in (*operands, *program.outputs) if c.of == VALUE)
        self.sources: dict[int, int | str] = {}  # value -> the source that layers read
        self.encodings: dict[str, Step] = {}
        self.started: dict[int, _Layer] = {}  # value of the sum so far -> the layer
        self.layers: list[Layer] = []
        self.finished: list[_Layer] = []

    def chain(self) -> Chain:
        """Returns the chain of the whole program."""
        behind = [step for step in self.program.steps if not self._takes(step)]
        values_behind, places, width = {step.out for step in behind}, dict[int, int](), 0
        for columns in (*(c for step in behind for c in step.operands), *self.program.outputs):
            if columns.of != VALUE:
                raise LookupError
            if columns.index not in values_behind | places.keys():
                places[columns.index], width = width, width + self.layers[self._layer(columns)].width
        b = Builder()
        x, values = b.input(width), dict[int, Columns]()

        def operand(c: Columns) -> Columns:
            whole = x.part(places[c.index], width) if c.index in places else values[c.index]
            return whole.part(c.start, c.width)._replace(spread=c.spread)

        for step in behind:
            values[step.out] = b.emit(step.op, step.width, [*map(operand, step.operands)], step.numbers, step.name)
        outputs = tuple(int(self.sources[value]) for value in places)
        features = [int(step.numbers[1]) for step in self.encodings.values() if step.name == HASH]
        layers = MLP(tuple(self.layers), outputs, **self._encoded())
        return Chain(
            layers,
            (0, 1) if layers.uses_directions else (0,),
            tuple(layer.weight for layer in self.finished),
            tuple(layer.bias for layer in self.finished),
            features[0] if features else None,
            b.program(map(operand, self.program.outputs)),
        )

    def _takes(self, step: Step) -> bool:
        """Converts a step if it belongs to the layer table, and returns whether it does."""
        if step.op == "input":
            self.sources[step.out] = _INPUTS[int(step.numbers[0])]
        elif step.op == "encode":
            if step.operands[0].index not in self.sources or step.numbers[2] or self.read[step.operands[0].index] > 1:
                raise LookupError
            name = self._source(step.operands[0])
            if not isinstance(name, str) or name in self.encodings:
                raise LookupError
            self.encodings[name], self.sources[step.out] = step, name
        elif step.op == "linear":
            self._add(step)
        elif step.op == "function" and step.name in ACTIVATIONS and self._activates(step):
            self._finish(step.operands[0].index, step.out, step.name)
        else:
            return False
        return True

    def _add(self, step: Step) -> None:
        """Adds a "linear" step to the layer whose sum it continues, or starts a new layer with the step."""
        (x, *added), (weight, start, transposed) = step.operands, map(int, step.numbers)
        layer, shapes = _Layer(weight), self.program.parameters
        if added and added[0].of == VALUE:
            layer = self.started.pop(added[0].index)
        elif added:
            layer = _Layer(weight, added[0].index)
        fits = (weight, start, step.width) == (layer.weight, layer.depth, shapes[weight][0])
        if step.name or transposed or not fits or (layer.bias is not None and shapes[layer.bias] != (step.width,)):
            raise LookupError
        inputs = (*layer.inputs, self._source(x))
        self.started[step.out] = layer._replace(inputs=inputs, depth=start + x.width)

    def _activates(self, step: Step) -> bool:
        """Returns whether a step is the activation of a layer whose sum no other step reads."""
        x = step.operands[0]
        numbers: tuple[float, ...] = (0, *NUMBERS.get(step.name, (0, 0)))
        if len(step.operands) > 1 or step.numbers != numbers or not self._is_whole(x):
            return False
        return x.index in self.started and self.read[x.index] == 1

    def _finish(self, value: int, out: int, activation: str) -> None:
        layer = self.started.pop(value)
        if layer.depth != self.program.parameters[layer.weight][1]:
            raise LookupError
        self.sources[out] = len(self.finished)
        self.finished.append(layer)
        self.layers.append(Layer(layer.inputs, self.program.parameters[layer.weight][0], activation))

    def _source(self, columns: Columns) -> int | str:
        """Returns the entry of ``Layer.inputs`` that names the source of columns.

        The columns must be all columns of an input or of a layer.

        If the columns are the sum of a layer under construction, the layer is finished without an activation.
        """
        if not self._is_whole(columns):
            raise LookupError
        if columns.index in self.started:
            self._finish(columns.index, columns.index, "none")
        return self.sources[columns.index]

    def _is_whole(self, columns: Columns) -> bool:
        return columns.of == VALUE and not columns.spread and columns.width == self.steps[columns.index].width

    def _layer(self, columns: Columns) -> int:
        """Returns the index of the layer whose output contains the columns."""
        source = self._source(Columns(VALUE, columns.index, 0, self.steps[columns.index].width))
        if isinstance(source, str):
            raise LookupError
        return source

    def _encoded(self) -> dict[str, Any]:
        """Returns the encodings as arguments of MLP."""
        arguments: dict[str, Any] = {}
        for name, step in self.encodings.items():
            size, of = int(step.numbers[0]), name.removesuffix("s")
            if step.name not in (POSITION_ENCODINGS if name == POSITIONS else DIRECTION_ENCODINGS):
                raise LookupError
            arguments[f"{of}_encoding"] = step.name
            if step.name == HASH:
                arguments["grid"] = HashGrid.parse(self.program.grids[size])
            else:
                arguments["direction_degree" if step.name == "spherical" else f"{of}_octaves"] = size
        return arguments
