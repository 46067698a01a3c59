"""Networks as one operation: fields with a layer table, and any module whose ``forward`` is fixed.

Such a module is traced once (:mod:`voronerf.router.trace`). Later calls run its layers as one operation, and do the
steps before and behind them again as they were, on rows in the original order. There, samples may meet parameters that
all cells share: tables, planes.

Letters: n samples, k cells.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops import routed_mlp
from voronerf.router.grouped import PerCell, for_all_cells
from voronerf.router.grouping import Grouping, owned_parameters
from voronerf.router.layout import Call, Results, map_tree, tensors_of
from voronerf.router.trace import TABLE, Linear, Ref, Segment, Step, Trace, Unfusable

# Fields with a layer table --------------------------------------------------------------------------------------------


@runtime_checkable
class LayeredField(Protocol):
    """A field that describes its network by a layer table, like :class:`voronerf.fields.NeRF`. It runs fused.

    Where the table has a hash grid, the field has a parameter ``features``, [e, f], as :class:`voronerf.HashGridField`.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.router import LayeredField
        >>> isinstance(NeRF(width=16, depth=2), LayeredField)
        True
    """

    layers: MLP

    def linears(self) -> list[nn.Linear]:
        """The linear layers in the table's order."""
        ...

    def activate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Turns the table's outputs [n, out] into what the field returns."""
        ...


def described_by_table(field: nn.Module) -> bool:
    """Whether the table, the weights and ``activate`` of a field describe all that it computes.

    They do not if a class has its own ``forward`` without its own ``linears`` and ``activate``, or if hooks or
    parametrisations, such as weight normalisation, change inputs, outputs or weights of layers.
    """
    first = {}
    for name in ("forward", "linears", "activate"):
        first[name] = next((i for i, base in enumerate(type(field).__mro__) if name in vars(base)), 0)
    if first["forward"] < max(first["linears"], first["activate"]) or "forward" in vars(field):
        return False
    return not any(
        part._forward_hooks
        or part._forward_pre_hooks
        or part._backward_hooks
        or part._backward_pre_hooks
        or "parametrizations" in part._modules
        for part in field.modules()
    )


def run_table(
    field: LayeredField,
    k: int,
    backend: str,
    positions: Tensor,
    directions: Tensor | None,
    ray_index: Tensor | None,
    where: dict[str, Any],
) -> Tensor:
    """What the networks of a field give before its ``activate``: [n, out]; ``where`` tells ``routed_mlp`` the cells."""
    linears = field.linears()
    # A parameter that all cells share has no dimension of cells; the operation takes one for each.
    weights = [w if w.dim() == 3 else w.expand(k, -1, -1) for w in [layer.weight for layer in linears]]
    biases = [b if b is None or b.dim() == 2 else b.expand(k, -1) for b in [layer.bias for layer in linears]]
    hashed = {} if field.layers.grid is None else {"features": field.features}  # type: ignore[attr-defined]
    given = {"directions": directions, "direction_index": ray_index, "backend": backend, **hashed, **where}
    return routed_mlp(positions, weights, biases, layers=field.layers, **given)[0]


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments for a field's own ``forward``: a direction for each sample, in the place of one for each ray."""
    names = ("positions", "directions", "ray_index")
    positions, directions, index = ((dict(zip(names, args)) | kwargs).get(name) for name in names)
    if directions is None or index is None:
        return args, kwargs
    others = {name: value for name, value in kwargs.items() if name not in names}
    return (positions, directions.index_select(0, index), None, *args[3:]), others


# Modules with a fixed forward -----------------------------------------------------------------------------------------


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
        self._writes = any(step.inplace for step in trace.before)
        self._owned = [(owner, name) for owner, name, _ in owned_parameters(original)]
        made = {value for step in trace.weights for value in step.values}
        of_layers = {value for layer in trace.layers for value in (layer.weight, layer.bias) if value is not None}
        self._used = of_layers.union(*[step.refs for step in trace.weights]) - made
        needed = [item for item in self._outputs if isinstance(item, Ref)]
        if not trace.layers:
            raise Unfusable("there is no linear layer")
        if any(trace.sizes[value] is None for value in needed):
            raise Unfusable("a result is made of parameters alone")
        self._behind: list[Step] = []
        for step in reversed(trace.behind):
            if step.inplace or any(value in needed for value in step.values):
                self._behind.insert(0, step)
                needed += step.refs
        self._needed = {v: trace.segments(v) for v in dict.fromkeys(needed) if trace.stages[v] == TABLE}
        self._make_table(trace.layers)

    def with_parameters_of(self, module: nn.Module) -> Program:
        """The same for a copy of the module, with parameters of its own."""
        copied = copy.copy(self)
        copied._owned = [(owner, name) for owner, name, _ in owned_parameters(module)]
        return copied

    def _make_table(self, layers: list[Linear]) -> None:
        uses = [s for segments in (*[li.inputs for li in layers], *self._needed.values()) for s in segments]
        self._pieces = [_cut([s for s in uses if s.layer == i]) for i in range(len(layers))]
        self._blocks: list[tuple[Segment, ...]] = []  # what layers read of the values from before
        self._parts: list[tuple[Linear, int, int, float]] = []
        table: list[Layer] = []
        numbers: dict[tuple[int, int], int] = {}
        for index, linear in enumerate(layers):
            inputs: list[int | str] = []
            for from_layers, group in itertools.groupby(linear.inputs, lambda segment: segment.layer >= 0):
                segments = tuple(group)
                if from_layers:
                    inputs += [numbers[s.layer, start] for s in segments for start, _ in self._pieces_of(s)]
                    continue
                if segments not in self._blocks:
                    self._blocks.append(segments)
                if len(self._blocks) > 2:
                    raise Unfusable("layers read more than two different inputs")
                inputs.append((POSITIONS, DIRECTIONS)[self._blocks.index(segments)])
            for (start, stop), (name, factor) in self._pieces[index].items():
                numbers[index, start] = len(table)
                table.append(Layer(tuple(inputs), stop - start, name))
                self._parts.append((linear, start, stop, factor))
        if not self._blocks:
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
        self._table = MLP(tuple(table), tuple(outputs))

    def _pieces_of(self, segment: Segment) -> list[tuple[int, int]]:
        """The pieces of its layer that a segment is made of."""
        pieces = self._pieces[segment.layer] if segment.layer >= 0 else ()
        return [piece for piece in pieces if segment.start <= piece[0] < segment.stop]

    # Running ----------------------------------------------------------------------------------------------------------

    def run(self, inputs: Sequence[Tensor], grouping: Grouping) -> Results:
        """The method's results for arguments in the original order, or sorted where the grouping has ``rows``."""
        n = inputs[0].shape[0]
        values: dict[int, Any] = dict(enumerate(x.clone() for x in inputs) if self._writes else enumerate(inputs))
        for value, place in self._parameters.items():
            owner, name = self._owned[place]
            values[value] = owner._parameters[name]
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
            blocks[0], weights, biases, layers=self._table, directions=directions, backend=grouping.backend, **where
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
        rows = [isinstance(item, Ref) for item in self._outputs]
        return Results(self._result, [values[x] if isinstance(x, Ref) else x for x in self._outputs], rows)

    def _stacked(self, values: dict[int, Any], k: int) -> tuple[list[Tensor], list[Tensor | None]]:
        """Weights [k, o, i] and biases [k, o] of the table, in its order."""
        known = {v: values[v].expand(k, *values[v].shape) if v in self._shared else values[v] for v in self._used}
        for step in self._weights:
            args, kwargs = map_tree(step.given, lambda _, v, nested: PerCell(known[v]) if isinstance(v, Ref) else v)
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
