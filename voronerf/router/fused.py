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
from voronerf.router.trace import TABLE, Column, Linear, Ref, Step, Trace, Unfusable

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
    """The layer table of one call of the routed module, and the steps before and behind it.

    Args:
        call: The call, which runs with the parameters of the first cell.
        given: The rows of the arguments, for ``ROWS`` samples.

    Raises:
        Unfusable: For a step that is no such network, or that cannot be done again for other samples.
    """

    def __init__(self, call: Call, given: list[Tensor]) -> None:
        trace = Trace(call, given)
        self._result, self._outputs = trace.result, trace.outputs
        self._before, self._weights = trace.before, trace.weights
        self._parameters, self._shared = trace.parameters, trace.shared
        self._writes = any(step.inplace for step in trace.before)
        self._owned = [(owner, name) for owner, name, _ in owned_parameters(call.module)]
        needed = [item for item in self._outputs if isinstance(item, Ref)]
        if len(needed) < len(self._outputs) or trace.made.intersection(needed):
            raise Unfusable("a result depends on no sample")
        self._behind: list[Step] = []
        for step in reversed(trace.behind):
            if step.inplace or any(value in needed for value in step.values):
                self._behind.insert(0, step)
                needed += step.refs
        self._make_table(trace, [value for value in dict.fromkeys(needed) if trace.stages[value] == TABLE])
        made = {value for step in trace.weights for value in step.values}
        of_layers = {value for layer in self._layers for value in (layer.weight, layer.bias) if value is not None}
        self._used = of_layers.union(*[step.refs for step in trace.weights]) - made

    def with_parameters_of(self, module: nn.Module) -> Program:
        """The same for a copy of the module, with parameters of its own."""
        copied = copy.copy(self)
        copied._owned = [(owner, name) for owner, name, _ in owned_parameters(module)]
        return copied

    def _make_table(self, trace: Trace, needed: list[int]) -> None:
        """The table of the layers that some values depend on. Layers read others, and blocks of values, whole."""
        columns = {value: trace.columns(value) for value in needed}
        returned = list(itertools.chain(*columns.values()))
        parts = {li: li.part([i for source, i in returned if source is li]) for li in _sources(returned, Linear)}
        if not parts:
            raise Unfusable("nothing that is returned comes from a layer")
        used, layers = set(parts.values()), list(dict.fromkeys([*trace.layers, *parts.values()]))
        for layer in reversed(layers):
            used.update(_sources(layer.inputs, Linear) if layer in used else ())
        self._layers = [layer for layer in layers if layer in used]
        reads = [_sources(layer.inputs, int) for layer in self._layers]
        first = next((read for read in reads if read), [])
        others = [value for value in dict.fromkeys(itertools.chain(*reads)) if value not in first]
        if not first:
            raise Unfusable("no layer reads the samples")
        self._blocks = [first, others] if others else [first]
        widths: dict[int | str, int] = {number: layer.width for number, layer in enumerate(self._layers)}
        places: dict[Linear | int, tuple[int | str, int]] = {layer: (i, 0) for i, layer in enumerate(self._layers)}
        for name, block in zip((POSITIONS, DIRECTIONS), self._blocks):
            for value in block:
                places[value] = name, widths.get(name, 0)
                widths[name] = widths.get(name, 0) + trace.values[value].shape[1:].numel()
        table = []
        self._orders: list[tuple[Tensor, int] | None] = []  # where the columns of a weight go among those of its inputs
        for layer in self._layers:
            read = [(places[source][0], places[source][1] + i) for source, i in layer.inputs]
            inputs = list(dict.fromkeys(name for name, _ in read))
            starts = dict(zip(inputs, itertools.accumulate((widths[name] for name in inputs), initial=0)))
            order, total = [starts[name] + i for name, i in read], sum(widths[name] for name in inputs)
            self._orders.append(None if order == list(range(total)) else (torch.tensor(order), total))
            table.append(Layer(tuple(inputs), layer.width, layer.activation))
        self._table = MLP(tuple(table), tuple(self._layers.index(part) for part in parts.values()))
        ends = itertools.accumulate(part.width for part in parts.values())
        begins = {li: end - part.width - part.start + li.start for (li, part), end in zip(parts.items(), ends)}
        self._shapes = {value: trace.values[value].shape[1:] for value in needed}
        self._ranges = {}  # columns of the raw outputs, or of a value from before, that make a value
        for value, own in columns.items():
            found = [(-1, begins[s] + i) if isinstance(s, Linear) else (s, i) for s, i in own]
            runs = [list(run) for _, run in itertools.groupby(enumerate(found), lambda x: (x[1][0], x[1][1] - x[0]))]
            self._ranges[value] = [(run[0][1][0], run[0][1][1], run[-1][1][1] + 1) for run in runs]

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
        blocks = [_joined([values[value].reshape(n, -1) for value in block]).contiguous() for block in self._blocks]
        weights, biases = self._stacked(values, grouping.k)
        where = grouping.where if grouping.rows is None else {"cells": grouping.sorted_cells.int()}
        directions = blocks[1] if len(blocks) > 1 else None
        raw, cells = routed_mlp(
            blocks[0], weights, biases, layers=self._table, directions=directions, backend=grouping.backend, **where
        )
        if where and grouping.rows is None:
            grouping.where = {"cells": cells}
        for value, ranges in self._ranges.items():
            parts = [(raw if source < 0 else values[source].reshape(n, -1), a, b) for source, a, b in ranges]
            joined = _joined([part if b - a == part.shape[1] else part[:, a:b] for part, a, b in parts])
            values[value] = joined.reshape(n, *self._shapes[value])
        for step in self._behind:
            step.run(values, n)
        return Results(self._result, [values[value] for value in self._outputs])

    def _stacked(self, values: dict[int, Any], k: int) -> tuple[list[Tensor], list[Tensor | None]]:
        """Weights [k, o, i] and biases [k, o] of the table, in its order."""
        known = {v: values[v].expand(k, *values[v].shape) if v in self._shared else values[v] for v in self._used}
        for step in self._weights:
            args, kwargs = map_tree(step.given, lambda _, v, nested: PerCell(known[v]) if isinstance(v, Ref) else v)
            results = tensors_of(for_all_cells(step.function, args, kwargs))
            known.update(zip(step.values, [r.stacked for r in results if isinstance(r, PerCell)], strict=True))
        weights: list[Tensor] = []
        biases: list[Tensor | None] = []
        for layer, order in zip(self._layers, self._orders, strict=True):
            weight, bias = known[layer.weight], None if layer.bias is None else known[layer.bias]
            if layer.width < weight.shape[1]:
                weight = weight[:, layer.start : layer.start + layer.width]
                bias = None if bias is None else bias[:, layer.start : layer.start + layer.width]
            if order is not None:
                weight = weight.new_zeros(*weight.shape[:2], order[1]).index_add(2, order[0].to(weight.device), weight)
            plain = layer.factor == 1
            weights.append(weight if plain else weight * layer.factor)
            biases.append(bias if plain or bias is None else bias * layer.factor)
        return weights, biases


def _sources(columns: Iterable[Column], kind: type[Any]) -> list[Any]:
    """Layers, or values, that columns belong to, each once."""
    return list(dict.fromkeys(source for source, _ in columns if isinstance(source, kind)))


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)
