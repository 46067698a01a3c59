"""Networks of a fixed ``forward`` as one operation: a layer table with the steps before and behind it.

What is before and behind the layers of a traced call is done again as it was, on rows in the original order.

Letters: n samples, k cells.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops import routed_mlp
from voronerf.router.cells import owned_parameters
from voronerf.router.grouped import PerCell, for_all_cells
from voronerf.router.grouping import Grouping
from voronerf.router.layout import Call, Results, tensors_of
from voronerf.router.tracing import ROWS as ROWS
from voronerf.router.tracing import TABLE, Linear, Ref, Segment, Step, Trace, Unfusable, map_arguments


class Program:
    """The layer table of one call of a copy of the routed module, and the steps before and behind it.

    Args:
        original: The routed module.
        call: Of the copy, which runs with the parameters of its first cell.
        given: The rows of the arguments, for ``ROWS`` samples.

    Raises:
        Unfusable: For a step that is no such network, or that cannot be done again for other samples.
    """

    def __init__(self, original: nn.Module, call: Call, given: list[Tensor]) -> None:
        trace = Trace(original, call, given)
        self._result, self._outputs = trace.result, trace.outputs
        self._before, self._weights = trace.before, trace.weights
        self._sizes, self._parameters, self._shared = trace.sizes, trace.parameters, trace.shared
        self._owned = [(owner, name) for owner, name, _ in owned_parameters(original)]
        made = {value for step in trace.weights for value in step.values}
        of_layers = {value for layer in trace.layers for value in (layer.weight, layer.bias) if value is not None}
        self._used = of_layers.union(*[step.refs() for step in trace.weights]) - made
        needed = [item.value for item in self._outputs if isinstance(item, Ref)]
        if not trace.layers:
            raise Unfusable("there is no linear layer")
        if any(trace.sizes[value] is None for value in needed):
            raise Unfusable("a result is made of parameters alone")
        self._behind: list[Step] = []
        for step in reversed(trace.behind):
            if step.inplace or any(value in needed for value in step.values):
                self._behind.insert(0, step)
                needed += step.refs()
        self._needed = {v: trace.segments(v) for v in dict.fromkeys(needed) if trace.stages[v] == TABLE}
        self._make_table(trace.layers)

    def with_parameters_of(self, module: nn.Module) -> Program:
        """The same for a copy of the module, with parameters of its own."""
        copied = copy.copy(self)
        copied._owned = [(owner, name) for owner, name, _ in owned_parameters(module)]
        return copied

    def _make_table(self, layers: list[Linear]) -> None:
        uses = [s for segments in (*[li.inputs for li in layers], *self._needed.values()) for s in segments]
        self._pieces = {i: _cut([s for s in uses if s.layer == i]) for i in range(len(layers))}
        blocks: list[tuple[Segment, ...]] = []
        table: list[Layer] = []
        numbers: dict[tuple[int, int], int] = {}
        self._parts: list[tuple[Linear, int, int, float]] = []
        for index, linear in enumerate(layers):
            inputs: list[int | str] = []
            for from_layers, group in itertools.groupby(linear.inputs, lambda segment: segment.layer >= 0):
                segments = tuple(group)
                if from_layers:
                    inputs += [numbers[s.layer, start] for s in segments for start, _ in self._pieces_of(s)]
                    continue
                if segments not in blocks:
                    blocks.append(segments)
                if len(blocks) > 2:
                    raise Unfusable("layers read more than two different inputs")
                inputs.append((POSITIONS, DIRECTIONS)[blocks.index(segments)])
            for (start, stop), (name, factor) in self._pieces[index].items():
                numbers[index, start] = len(table)
                table.append(Layer(tuple(inputs), stop - start, name))
                self._parts.append((linear, start, stop, factor))
        if not blocks:
            raise Unfusable("no layer reads the samples")
        self._raw: dict[tuple[int, int], int] = {}  # where each piece begins in the outputs
        outputs: list[int] = []
        for segment in [segment for segments in self._needed.values() for segment in segments]:
            for start, _ in self._pieces_of(segment):
                if (segment.layer, start) not in self._raw:
                    self._raw[segment.layer, start] = sum(table[number].width for number in outputs)
                    outputs.append(numbers[segment.layer, start])
        if not outputs:
            raise Unfusable("nothing that is returned comes from a layer")
        self._blocks, self.table = blocks, MLP(tuple(table), tuple(outputs))

    def _pieces_of(self, segment: Segment) -> list[tuple[int, int]]:
        """The pieces of its layer that a segment is made of."""
        pieces = self._pieces.get(segment.layer, {})
        return [piece for piece in pieces if segment.start <= piece[0] < segment.stop]

    # Running ----------------------------------------------------------------------------------------------------------

    def run(self, inputs: Sequence[Tensor], grouping: Grouping) -> Results:
        """The method's results for arguments in the original order, or sorted where the grouping has ``rows``."""
        n = inputs[0].shape[0]
        parameters = {value: self._parameter(place) for value, place in self._parameters.items()}
        values: dict[int, Any] = {**dict(enumerate(inputs)), **parameters}
        for step in self._before:
            step.run(values, n)
        blocks = [
            _joined([(values[s.value].reshape(n, -1), s.start, s.stop) for s in block]).contiguous()
            for block in self._blocks
        ]
        weights, biases = self._stacked(values, grouping.k)
        where = grouping.where if grouping.rows is None else {"cells": grouping.sorted_cells.int()}
        directions = blocks[1] if len(blocks) > 1 else None
        raw, cells = routed_mlp(
            blocks[0], weights, biases, layers=self.table, directions=directions, backend=grouping.backend, **where
        )
        if where and grouping.rows is None:
            grouping.where = {"cells": cells}
        for value, segments in self._needed.items():
            ranges = []
            for s in segments:
                if s.layer < 0:
                    ranges.append((values[s.value].reshape(n, -1), s.start, s.stop))
                at = [(self._raw[s.layer, start], stop - start) for start, stop in self._pieces_of(s)]
                ranges += [(raw, first, first + width) for first, width in at]
            m, *sizes = self._sizes[value] or ()
            values[value] = _joined(ranges).reshape(n * m, *sizes)
        for step in self._behind:
            step.run(values, n)
        tensors = [values[item.value] if isinstance(item, Ref) else item for item in self._outputs]
        return Results(self._result, tensors, [isinstance(item, Ref) for item in self._outputs])

    def _parameter(self, place: int) -> nn.Parameter:
        owner, name = self._owned[place]
        parameter = owner._parameters[name]
        assert parameter is not None
        return parameter

    def _stacked(self, values: dict[int, Any], k: int) -> tuple[list[Tensor], list[Tensor | None]]:
        """Weights [k, o, i] and biases [k, o] of the table, in its order."""
        known = {v: values[v].expand(k, *values[v].shape) if v in self._shared else values[v] for v in self._used}
        for step in self._weights:
            args, kwargs = map_arguments(
                (step.args, step.kwargs), lambda v: PerCell(known[v.value]) if isinstance(v, Ref) else v
            )
            results = tensors_of(for_all_cells(step.function, args, kwargs))
            known.update(zip(step.values, [r.stacked for r in results if isinstance(r, PerCell)], strict=True))

        def part(value: int, linear: Linear, start: int, stop: int, factor: float) -> Tensor:
            tensor: Tensor = known[value]
            tensor = tensor if stop - start == linear.width else tensor[:, start:stop]
            return tensor if factor == 1 else tensor * factor

        weights = [part(own[0].weight, *own) for own in self._parts]
        return weights, [None if own[0].bias is None else part(own[0].bias, *own) for own in self._parts]


def _cut(uses: list[Segment]) -> dict[tuple[int, int], tuple[str, float]]:
    """The pieces that a layer falls into, so that every use is of whole pieces: activations by (start, stop)."""
    pieces = {}
    for start, stop in itertools.pairwise(sorted({edge for use in uses for edge in (use.start, use.stop)})):
        found = {use.activation for use in uses if use.start < stop and start < use.stop}
        if len(found) > 1:
            raise Unfusable("a layer is used before and after its activation")
        if found:
            pieces[start, stop] = found.pop()
    return pieces


def _joined(ranges: Iterable[tuple[Tensor, int, int]]) -> Tensor:
    """Columns ``start`` to ``stop`` of each tensor, side by side."""
    joined: list[tuple[Tensor, int, int]] = []
    for source, start, stop in ranges:
        if joined and joined[-1][0] is source and joined[-1][2] == start:
            start = joined.pop()[1]
        joined.append((source, start, stop))
    parts = [tensor if b - a == tensor.shape[1] else tensor[:, a:b] for tensor, a, b in joined]
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)
