"""Networks of a fixed ``forward`` as one operation: a layer table with the steps before and behind it.

A traced call (:mod:`voronerf.router.tracing`) is cut in three: what comes before the first layer (encodings); the
layers with their concatenations, slices and activations, which become a layer table; and what comes behind them
(activations of heads, dicts). The first and the last part are done again as they were, on rows in the original order.

Letters: n samples, d features. A segment is a range of columns of a value from before the layers, or of a layer.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops import routed_mlp
from voronerf.router.grouped import PerCell, for_all_cells, name_of
from voronerf.router.grouping import Entries, Grouping
from voronerf.router.loop import Results
from voronerf.router.parameters import is_shared, owned_parameters
from voronerf.router.tracing import (
    Ref,
    Step,
    Trace,
    Unfusable,
    activation_of,
    map_arguments,
    with_scales,
)
from voronerf.router.trees import tensors_of

_MOVES = """
    cat concat concatenate hstack dstack stack split chunk tensor_split unbind __getitem__ narrow select index_select
    permute transpose swapaxes swapdims movedim moveaxis reshape view view_as reshape_as flatten unflatten unsqueeze
    squeeze expand expand_as broadcast_to contiguous clone repeat tile flip roll
"""
_MOVERS = frozenset(
    getattr(place, name) for place in (torch, torch.Tensor) for name in _MOVES.split() if hasattr(place, name)
)
"""What may move columns without changing them."""


@dataclass(frozen=True)
class Segment:
    """Columns ``start`` to ``stop`` of a value, or of layer ``layer`` before or after its activation."""

    value: int
    layer: int
    activated: bool
    start: int
    stop: int

    def part(self, start: int, stop: int) -> Segment:
        """Some of its columns, counted from its own first."""
        return replace(self, start=self.start + start, stop=self.start + stop)


Columns = tuple[Segment, ...]


@dataclass
class _Linear:
    """A linear layer of the trace: the values of its parameters, where its inputs come from, and its scale."""

    weight: int
    bias: int | None
    columns: Columns
    width: int
    scale: float = 1.0


class Program:
    """A layer table with the steps before and behind it.

    Raises:
        Unfusable: Where the steps are not such a network.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self._columns: dict[int, Columns] = {value: self._whole(value) for value in range(trace.inputs)}
        self._layers: list[_Linear] = []
        self._activations: dict[int, list[tuple[int, int, str]]] = {}
        self._before: list[Step] = []
        self._behind: list[Step] = []
        self._weights: list[Step] = []
        late: set[int] = set()
        for step in with_scales(trace):
            self._place(step, late)
        if not self._layers:
            raise Unfusable("there is no linear layer")
        self._make_table()
        for step in self._before:
            if step.inplace:  # in the original order, which may be what the caller gave
                raise Unfusable(f"{name_of(step.function)} changes a tensor before the first layer{step.line}")

    def _whole(self, value: int) -> Columns:
        sizes = self.trace.sizes[value]
        assert sizes is not None
        return (Segment(value, -1, False, 0, math.prod(sizes)),)

    def with_parameters_of(self, original: nn.Module, module: nn.Module) -> Program:
        """The same for a copy of the module, with parameters of its own."""
        places = {
            (id(owner), name): (other, name)
            for (owner, name, _), (other, _, _) in zip(owned_parameters(original), owned_parameters(module))
        }
        copied = copy.copy(self)
        own = {number: places[id(owner), name] for number, (owner, name) in self.trace.parameters.items()}
        copied.trace = replace(self.trace, parameters=own)
        return copied

    # Cutting the trace ------------------------------------------------------------------------------------------------

    def _place(self, step: Step, late: set[int]) -> None:
        sizes, refs = self.trace.sizes, step.refs()
        rows, parameters = [r for r in refs if sizes[r] is not None], [r for r in refs if sizes[r] is None]
        if parameters and step.function is not F.linear:
            if rows or any(sizes[value] is not None for value in step.values):
                raise Unfusable(f"parameters meet samples in {name_of(step.function)}{step.line}")
            self._weights.append(step)
            return
        if parameters:
            self._place_linear(step, late)
            return
        layered = [r for r in rows if r not in late and _from_layers(self._columns[r])]
        if not layered and not any(r in late for r in rows):
            self._before.append(step)
            self._columns.update({value: self._whole(value) for value in step.values})
            return
        if not any(r in late for r in rows):
            name = activation_of(step)
            if name is not None and self._activate(step, rows, name):
                return
            moved = None if step.inplace else self._moved(step)
            if moved is not None:
                self._columns.update(zip(step.values, moved, strict=True))
                return
        late.update(step.values)
        self._behind.append(step)

    def _place_linear(self, step: Step, late: set[int]) -> None:
        given = {**dict(zip(("input", "weight", "bias"), step.args)), **step.kwargs}
        source, weight, bias = (
            item.value if isinstance(item, Ref) else None
            for item in (given["input"], given["weight"], given.get("bias"))
        )
        sizes = self.trace.sizes
        if source is None or weight is None or sizes[source] is None or sizes[weight] is not None:
            raise Unfusable(f"a layer has weights or inputs that are neither parameters nor samples{step.line}")
        if source in late:
            earlier = next(s for s in self._behind if source in s.values)
            name = f"{name_of(earlier.function)}{earlier.line}"
            raise Unfusable(f"a layer reads the result of {name}, which is no activation or arrangement of a table")
        own = sizes[source]
        assert own is not None
        if own[:1] != (1,) or any(size != 1 for size in own[1:-1]):
            raise Unfusable(f"a layer runs on more than one row for each sample{step.line}")
        out = sizes[step.values[0]]
        assert out is not None
        scale = given.get("scale", 1.0)
        self._layers.append(_Linear(weight, bias, self._columns[source], math.prod(out), scale))
        self._columns[step.values[0]] = (Segment(-1, len(self._layers) - 1, False, 0, math.prod(out)),)

    def _activate(self, step: Step, rows: list[int], name: str) -> bool:
        if len(rows) != 1 or len(self._columns[rows[0]]) != 1:
            return False
        (segment,) = self._columns[rows[0]]
        applied = self._activations.setdefault(segment.layer, [])
        found = (segment.start, segment.stop, name)
        if segment.activated or any(a < found[1] and found[0] < b and (a, b, c) != found for a, b, c in applied):
            return False
        applied.append(found)
        self._columns[step.values[0]] = (replace(segment, activated=True),)
        return True

    def _moved(self, step: Step) -> list[Columns] | None:
        """The columns of the results of a function that only moves columns; None for any other.

        Found by running it on rows of numbers that name columns.
        """
        if step.function not in _MOVERS:
            return None
        count = 3
        names: list[Segment] = []
        coded: dict[int, Tensor] = {}
        for ref in step.refs():
            if ref not in coded:
                singles = [s.part(i, i + 1) for s in self._columns[ref] for i in range(s.stop - s.start)]
                codes = torch.arange(len(names), len(names) + len(singles), dtype=torch.float64)
                names += singles
                m, *rest = self.trace.sizes[ref] or ()
                coded[ref] = (codes + 1e6 * torch.arange(count)[:, None]).reshape(count * m, *rest)
        values: dict[int, Any] = dict(coded)
        try:
            step.run(values, count)
        except Exception:
            return None
        found = []
        for value in step.values:
            m, *rest = self.trace.sizes[value] or ()
            result = values[value]
            if tuple(result.shape) != (count * m, *rest) or result.dtype != torch.float64:
                return None
            rows = result.reshape(count, -1)
            if not torch.equal(rows, rows[:1] + 1e6 * torch.arange(count, dtype=torch.float64)[:, None]):
                return None
            found.append(_join_segments([names[int(code)] for code in rows[0].tolist()]))
        return found

    # The table --------------------------------------------------------------------------------------------------------

    def _make_table(self) -> None:
        behind = [ref for step in self._behind for ref in step.refs()]
        results = [item.value for item in self.trace.outputs if isinstance(item, Ref)]
        if any(self.trace.sizes[value] is None for value in results):
            raise Unfusable("a result is made of parameters alone")
        needed = [v for v in dict.fromkeys(results + behind) if v in self._columns]
        self._needed = [v for v in needed if _from_layers(self._columns[v])]
        used = [layer.columns for layer in self._layers] + [self._columns[value] for value in self._needed]
        self._pieces = self._cut([segment for columns in used for segment in columns if segment.layer >= 0])
        blocks: list[Columns] = []
        table: list[Layer] = []
        numbers: dict[tuple[int, int], int] = {}
        self._parts: list[tuple[_Linear, int, int]] = []
        for index, linear in enumerate(self._layers):
            inputs: list[int | str] = []
            for from_layers, group in itertools.groupby(linear.columns, lambda segment: segment.layer >= 0):
                segments = tuple(group)
                if from_layers:
                    inputs += [
                        numbers[s.layer, start]
                        for s in segments
                        for start, _, _ in self._pieces[s.layer]
                        if s.start <= start < s.stop
                    ]
                    continue
                block = _join_segments(segments)
                if block not in blocks:
                    blocks.append(block)
                if len(blocks) > 2:
                    raise Unfusable("layers read more than two different inputs")
                inputs.append((POSITIONS, DIRECTIONS)[blocks.index(block)])
            for start, stop, activation in self._pieces.get(index, []):
                numbers[index, start] = len(table)
                table.append(Layer(tuple(inputs), stop - start, activation))
                self._parts.append((linear, start, stop))
        if not blocks:
            raise Unfusable("no layer reads the samples")
        outputs: list[int] = []
        self._raw: dict[tuple[int, int], int] = {}
        at = 0
        for segment in [segment for value in self._needed for segment in self._columns[value]]:
            for start, stop, _ in self._pieces.get(segment.layer, []):
                if segment.start <= start < segment.stop and (segment.layer, start) not in self._raw:
                    self._raw[segment.layer, start] = at
                    outputs.append(numbers[segment.layer, start])
                    at += stop - start
        if not outputs:
            raise Unfusable("nothing that is returned comes from a layer")
        self._blocks, self._raw_width = blocks, at
        self.table = MLP(tuple(table), tuple(outputs))

    def _cut(self, used: list[Segment]) -> dict[int, list[tuple[int, int, str]]]:
        """The parts that each layer falls into, so that every use is of whole parts: (start, stop, activation)."""
        pieces: dict[int, list[tuple[int, int, str]]] = {}
        for layer in sorted({segment.layer for segment in used}):
            uses = [segment for segment in used if segment.layer == layer]
            applied = self._activations.get(layer, [])
            edges = {edge for segment in uses for edge in (segment.start, segment.stop)}
            edges |= {edge for start, stop, _ in applied for edge in (start, stop)}
            pieces[layer] = []
            for start, stop in itertools.pairwise(sorted(edges)):
                over = {s.activated for s in uses if s.start < stop and start < s.stop}
                if len(over) == 2:
                    raise Unfusable("a layer is used before and after its activation")
                if over:
                    name = next((name for a, b, name in applied if a <= start < b), "none") if True in over else "none"
                    pieces[layer].append((start, stop, name))
        return pieces

    # Running ----------------------------------------------------------------------------------------------------------

    def run(self, inputs: Sequence[Tensor], grouping: Grouping) -> Results:
        """The method's results for arguments in the original order, or sorted for ``Entries``.

        The samples need not have been located yet.
        """
        n, chosen = inputs[0].shape[0], isinstance(grouping, Entries)
        values: dict[int, Any] = dict(enumerate(inputs))
        for step in self._before:
            step.run(values, n)
        positions = self._block(values, self._blocks[0], n)
        directions = self._block(values, self._blocks[1], n) if len(self._blocks) > 1 else None
        weights, biases = self._parameters(grouping.k)
        if chosen:
            where: dict[str, Any] = {"cells": grouping.sorted_cells.int()}
        else:
            where = {"cells": grouping.cells} if grouping.tables is None else grouping.tables
        raw, cells = routed_mlp(
            positions, weights, biases, layers=self.table, directions=directions, backend=grouping.backend, **where
        )
        if not chosen and grouping.tables is not None:
            grouping.found(cells)
        for value in self._needed:
            values[value] = self._from_raw(values, raw, value, n)
        for step in self._behind:
            step.run(values, n)
        outputs = self.trace.outputs
        tensors = [values[item.value] if isinstance(item, Ref) else item for item in outputs]
        return Results(self.trace.result, tensors, [isinstance(item, Ref) for item in outputs], [False] * len(outputs))

    def _parameters(self, k: int) -> tuple[list[Tensor], list[Tensor | None]]:
        """Weights [k, o, i] and biases [k, o] of the table, in its order."""
        known: dict[int, Any] = {}

        def stacked(value: int) -> Tensor:
            if value not in known:
                owner, name = self.trace.parameters[value]
                parameter = owner._parameters[name]
                assert parameter is not None
                known[value] = parameter.expand(k, *parameter.shape) if is_shared(owner, name) else parameter
            found: Tensor = known[value]
            return found

        for step in self._weights:
            args, kwargs = map_arguments(
                (step.args, step.kwargs), lambda v: PerCell(stacked(v.value)) if isinstance(v, Ref) else v
            )
            results = tensors_of(for_all_cells(step.function, args, kwargs))
            known.update(zip(step.values, [r.stacked for r in results if isinstance(r, PerCell)], strict=True))
        weights, biases = [], []
        for linear, start, stop in self._parts:
            pair = [stacked(linear.weight), None if linear.bias is None else stacked(linear.bias)]
            if stop - start < linear.width:
                pair = [None if tensor is None else tensor[:, start:stop] for tensor in pair]
            if linear.scale != 1:
                pair = [None if tensor is None else tensor * linear.scale for tensor in pair]
            weights.append(pair[0])
            biases.append(pair[1])
        return weights, biases  # type: ignore[return-value]

    def _block(self, values: dict[int, Any], block: Columns, n: int) -> Tensor:
        parts = [values[s.value].reshape(n, -1)[:, s.start : s.stop] for s in block]
        return torch.cat(parts, 1) if len(parts) > 1 else parts[0].contiguous()

    def _from_raw(self, values: dict[int, Any], raw: Tensor, value: int, n: int) -> Tensor:
        ranges: list[tuple[Tensor, int, int]] = []

        def add(source: Tensor, start: int, stop: int) -> None:
            if ranges and ranges[-1][0] is source and ranges[-1][2] == start:
                start = ranges.pop()[1]
            ranges.append((source, start, stop))

        for segment in self._columns[value]:
            if segment.layer < 0:
                add(values[segment.value].reshape(n, -1), segment.start, segment.stop)
            for start, stop, _ in self._pieces.get(segment.layer, ()):
                if segment.start <= start < segment.stop:
                    at = self._raw[segment.layer, start]
                    add(raw, at, at + stop - start)
        parts = [tensor if b - a == tensor.shape[1] else tensor[:, a:b] for tensor, a, b in ranges]
        rows = parts[0] if len(parts) == 1 else torch.cat(parts, 1)
        m, *sizes = self.trace.sizes[value] or ()
        return rows if sizes == [rows.shape[1]] and m == 1 else rows.reshape(n * m, *sizes)


def _from_layers(columns: Columns) -> bool:
    return any(segment.layer >= 0 for segment in columns)


def _join_segments(segments: Sequence[Segment]) -> Columns:
    """The same columns in as few segments as possible."""
    merged: list[Segment] = []
    for segment in segments:
        if merged and segment == replace(merged[-1], start=merged[-1].stop, stop=segment.stop):
            segment = replace(merged.pop(), stop=segment.stop)
        merged.append(segment)
    return tuple(merged)
