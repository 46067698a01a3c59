"""Recognising networks that ``routed_mlp`` can run as a whole, whatever code they are written in.

A recorded call (``voronerf.router.recording``) is cut in three: what comes before the first layer (encodings), the
layers with their concatenations, slices and activations, which become a layer table, and what comes behind them
(activations of heads, dicts). The first and last part are done again as they were, on rows in the original order. A
plan is used after two calls of a kind took the same steps, and after it gave the module's own results.

d features of a row. A segment is a range of columns of a value from before the layers, or of a layer's outputs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops import routed_mlp
from voronerf.router.arguments import map_result, tensors_of
from voronerf.router.columns import Columns, Segment, join_segments, move_columns, refs_in
from voronerf.router.grouping import Grouping
from voronerf.router.recording import Program, Ref, Slot, Step
from voronerf.router.rows import replace, tensors_in


class Unrecognised(Exception):
    """A program is not a network that a layer table describes; the message says why."""


def activation_of(step: Step) -> str | None:
    """The name that a layer table has for a step's function, or None."""
    function, rest = step.function, (step.args[1:], {k: v for k, v in step.kwargs.items() if k != "inplace"})
    if function in (F.relu, torch.relu, torch.relu_, torch.Tensor.relu, torch.Tensor.relu_, F.relu_):
        return "relu"
    if function in (torch.sigmoid, torch.Tensor.sigmoid, F.sigmoid, torch.sigmoid_, torch.Tensor.sigmoid_):
        return "sigmoid"
    if function in (torch.sin, torch.Tensor.sin, torch.sin_, torch.Tensor.sin_):
        return "sine"
    if function is F.softplus and rest in (((), {}), ((1, 20), {}), ((1.0, 20.0), {}), ((), {"beta": 1})):
        return "softplus"
    return None


class Plan:
    """A layer table with the steps before and behind it.

    Attributes:
        uses: how often it was run, for its owner to count.

    Args:
        program: a recorded call.

    Raises:
        Unrecognised: when it is not such a network.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self.uses = 0
        self._columns: dict[int, Columns] = {}
        self._layers: list[tuple[tuple[Slot, Slot | None], Columns, int]] = []
        self._activations: dict[int, list[tuple[int, int, str]]] = {}
        self._before: list[Step] = []
        self._behind: list[Step] = []
        late: set[int] = set()
        for value in range(program.inputs):
            self._columns[value] = self._whole(value)
        for step in program.steps:
            self._place(step, late)
        if not self._layers:
            raise Unrecognised("it has no linear layer")
        self._make_table()
        # In the original order a step in front of the layers must not write to what the caller gave.
        if any(step.inplace for step in self._before):
            raise Unrecognised("it changes tensors in place before the first layer")

    def fits(self, n: int) -> bool:
        """Whether it holds for a number of samples."""
        return self.program.only_n in (None, n)

    def _whole(self, value: int) -> Columns:
        return (Segment(value, -1, False, 0, math.prod(self.program.sizes[value])),)

    def _place(self, step: Step, late: set[int]) -> None:
        sources = [ref.value for ref in refs_in((step.args, step.kwargs))]
        if step.layer is not None:
            (source,) = sources
            if source in late:
                raise Unrecognised("a layer reads what is not a layer or an input")
            if self.program.sizes[source][:1] != (1,) or any(s != 1 for s in self.program.sizes[source][1:-1]):
                raise Unrecognised("a layer runs on more than one row for each sample")
            width = math.prod(self.program.sizes[step.values[0]])
            self._layers.append((step.layer, self._columns[source], width))
            self._columns[step.values[0]] = (Segment(-1, len(self._layers) - 1, False, 0, width),)
            return
        layered = [value for value in sources if value not in late and _from_layers(self._columns[value])]
        if not layered and not any(value in late for value in sources):
            self._before.append(step)
            for value in step.values:
                self._columns[value] = self._whole(value)
            return
        if not any(value in late for value in sources):
            name = activation_of(step)
            if name is not None and self._activate(step, sources, name):
                return
            moved = None if step.inplace else move_columns(step, self.program, self._columns)
            if moved is not None:
                self._columns.update(zip(step.values, moved, strict=True))
                return
        late.update(step.values)
        self._behind.append(step)

    def _activate(self, step: Step, sources: list[int], name: str) -> bool:
        if len(sources) != 1 or len(self._columns[sources[0]]) != 1:
            return False
        (segment,) = self._columns[sources[0]]
        if segment.activated:
            return False
        applied = self._activations.setdefault(segment.layer, [])
        if any(
            start < segment.stop and segment.start < stop and found != (start, stop, name)
            for start, stop, _ in applied
            for found in [(segment.start, segment.stop, name)]
        ):
            return False
        applied.append((segment.start, segment.stop, name))
        self._columns[step.values[0]] = (Segment(-1, segment.layer, True, segment.start, segment.stop),)
        return True

    # The table --------------------------------------------------------------------------------------------------------

    def _make_table(self) -> None:
        program = self.program
        behind = [ref.value for step in self._behind for ref in refs_in((step.args, step.kwargs))]
        results = [ref.value for ref in _refs_of_result(program.result)]
        self._needed = [v for v in dict.fromkeys(results + behind) if v in self._columns]
        self._needed = [v for v in self._needed if _from_layers(self._columns[v])]
        used = [columns for _, columns, _ in self._layers] + [self._columns[value] for value in self._needed]
        pieces = self._cut([segment for columns in used for segment in columns if segment.layer >= 0])

        blocks: list[Columns] = []
        table: list[Layer] = []
        numbers: dict[tuple[int, int], int] = {}
        self._parts: list[tuple[Slot, Slot | None, int, int, bool]] = []
        for index, ((weight, bias), columns, width) in enumerate(self._layers):
            inputs: list[int | str] = []
            run: list[Segment] = []
            for segment in (*columns, None):
                if segment is not None and segment.layer < 0:
                    run.append(segment)
                    continue
                if run:
                    block = join_segments(run)
                    if block not in blocks:
                        blocks.append(block)
                    inputs.append(self._source(blocks, block))
                    run = []
                if segment is not None:
                    inputs += [
                        numbers[segment.layer, start]
                        for start, _, _ in pieces[segment.layer]
                        if segment.start <= start < segment.stop
                    ]
            for start, stop, activation in pieces.get(index, []):
                numbers[index, start] = len(table)
                table.append(Layer(tuple(inputs), stop - start, activation))
                self._parts.append((weight, bias, start, stop, stop - start == width))
        outputs: list[int] = []
        self._raw: dict[tuple[int, int], int] = {}
        at = 0
        for value in self._needed:
            for segment in self._columns[value]:
                for start, stop, _ in pieces.get(segment.layer, []):
                    if segment.start <= start < segment.stop and (segment.layer, start) not in self._raw:
                        self._raw[segment.layer, start] = at
                        outputs.append(numbers[segment.layer, start])
                        at += stop - start
        if not outputs:
            raise Unrecognised("nothing that it returns comes from a layer")
        self._pieces, self._blocks, self._raw_width = pieces, blocks, at
        self.table = MLP(tuple(table), tuple(outputs))

    def _source(self, blocks: list[Columns], block: Columns) -> str:
        if blocks.index(block) > 1:
            raise Unrecognised("its layers read more than two different inputs")
        return (POSITIONS, DIRECTIONS)[blocks.index(block)]

    def _cut(self, used: list[Segment]) -> dict[int, list[tuple[int, int, str]]]:
        """The parts that each layer falls into, so that every use is of whole parts: (start, stop, activation)."""
        pieces: dict[int, list[tuple[int, int, str]]] = {}
        for layer in sorted({segment.layer for segment in used}):
            uses = [segment for segment in used if segment.layer == layer]
            applied = self._activations.get(layer, [])
            edges = {edge for segment in uses for edge in (segment.start, segment.stop)}
            edges |= {edge for start, stop, _ in applied for edge in (start, stop)}
            ordered = sorted(edges)
            pieces[layer] = []
            for start, stop in itertools.pairwise(ordered):
                over = {s.activated for s in uses if s.start < stop and start < s.stop}
                if not over:
                    continue
                if len(over) == 2:
                    raise Unrecognised("a layer is used before and after its activation")
                name = next((name for a, b, name in applied if a <= start < b), "none") if True in over else "none"
                pieces[layer].append((start, stop, name))
        return pieces

    # Running ----------------------------------------------------------------------------------------------------------

    def run(self, inputs: Sequence[Tensor], grouping: Grouping) -> Any:
        """The module's results for rows in the original order.

        Args:
            inputs: the tensors of rows among the arguments.
            grouping: of the samples, which need not have been located yet.
        """
        n = grouping.n
        values: dict[int, Tensor] = dict(enumerate(inputs))
        for step in self._before:
            _do(step, values)
        positions, directions = ([*[self._block(values, block, n) for block in self._blocks], None, None])[:2]
        weights, biases = [], []
        for (owner, name), bias, start, stop, whole in self._parts:
            weight = owner._parameters[name]
            assert weight is not None
            offset = None if bias is None else bias[0]._parameters[bias[1]]
            weights.append(weight if whole else weight[:, start:stop])
            biases.append(offset if whole or offset is None else offset[:, start:stop])
        if positions is None:
            raise Unrecognised("its layers read no input")
        where = {"cells": grouping.cells} if grouping.tables is None else grouping.tables
        raw, cells = routed_mlp(
            positions,
            weights,
            biases,
            layers=self.table,
            directions=directions,
            backend=grouping.backend,
            **where,
        )
        if grouping.tables is not None:
            grouping.found(cells)
        for value in self._needed:
            values[value] = self._from_raw(values, raw, value, n)
        for step in self._behind:
            _do(step, values)
        return map_refs(self.program.result, values)

    def _block(self, values: dict[int, Tensor], block: Columns, n: int) -> Tensor:
        parts = [values[s.value].reshape(n, -1)[:, s.start : s.stop] for s in block]
        return parts[0].contiguous() if len(parts) == 1 else torch.cat(parts, 1)

    def _from_raw(self, values: dict[int, Tensor], raw: Tensor, value: int, n: int) -> Tensor:
        ranges: list[tuple[int, int]] = []
        parts: list[Tensor] = []

        def flush() -> None:
            for start, stop in ranges:
                parts.append(raw if (start, stop) == (0, self._raw_width) else raw[:, start:stop])
            ranges.clear()

        for segment in self._columns[value]:
            if segment.layer < 0:
                flush()
                parts.append(values[segment.value].reshape(n, -1)[:, segment.start : segment.stop])
                continue
            for start, stop, _ in self._pieces[segment.layer]:
                if segment.start <= start < segment.stop:
                    at = self._raw[segment.layer, start]
                    if ranges and ranges[-1][1] == at:
                        ranges[-1] = (ranges[-1][0], at + stop - start)
                    else:
                        ranges.append((at, at + stop - start))
        flush()
        rows = parts[0] if len(parts) == 1 else torch.cat(parts, 1)
        m, *sizes = self.program.sizes[value]
        return rows if sizes == [rows.shape[1]] and m == 1 else rows.reshape(n * m, *sizes)


def _from_layers(columns: Columns) -> bool:
    return any(segment.layer >= 0 for segment in columns)


def _refs_of_result(value: Any) -> list[Ref]:
    if isinstance(value, Ref):
        return [value]
    if isinstance(value, dict):
        return [ref for item in value.values() for ref in _refs_of_result(item)]
    if isinstance(value, (list, tuple)):
        return [ref for item in value for ref in _refs_of_result(item)]
    if hasattr(value, "__dict__") and not callable(value):
        return [ref for item in vars(value).values() for ref in _refs_of_result(item)]
    return []


def map_refs(value: Any, values: dict[int, Tensor]) -> Any:
    """A recorded result with its tensors."""
    return map_result(value, lambda ref: values[ref.value], leaf=Ref)


def _do(step: Step, values: dict[int, Tensor]) -> None:
    given = replace((step.args, step.kwargs), lambda item: values[item.value] if isinstance(item, Ref) else item)
    result = step.function(*given[0], **given[1])
    found = [given[0][0]] if step.inplace else list(tensors_in(result))
    values.update(zip(step.values, found, strict=True))


def agree(found: Any, expected: Any) -> bool:
    """Whether a plan's results are the module's own, up to rounding."""
    ours, theirs = tensors_of(found), tensors_of(expected)
    if len(ours) != len(theirs):
        return False
    for a, b in zip(ours, theirs, strict=True):
        if a.shape != b.shape or a.dtype != b.dtype:
            return False
        if not b.is_floating_point():
            if not torch.equal(a, b):
                return False
            continue
        finite = b.detach()[b.isfinite()]
        scale = float(finite.abs().max()) if finite.numel() else 1.0
        tolerance = 3e-2 if b.dtype.itemsize < 4 else 1e-4
        close = torch.allclose(a.double(), b.double(), rtol=tolerance, atol=tolerance * scale, equal_nan=True)
        if not close:
            return False
    return True
