"""The network of a module whose ``forward`` is fixed, as one operation.

The module is traced once (:mod:`voronerf.router.trace`). Later calls run its layers as one operation, and do the
steps before and behind them again as they were, on rows in the original order. There, samples may meet parameters that
all cells share: tables, planes.

Letters: n samples, k cells.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, fx
from torch.fx.node import map_arg

from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops.routed_mlp import routed_mlp
from voronerf.router.grouped import PerCell, for_all_cells
from voronerf.router.grouping import Grouping, owned_parameters
from voronerf.router.layout import Call, Results, map_tensors, map_tree
from voronerf.router.trace import BEFORE, BEHIND, CELLS, LAYERS, Column, Linear, Trace, Unfusable


def fuse(call: Call, given: list[Tensor]) -> Program:
    """The fused way of a call, traced for the first cell on ``ROWS`` rows of its arguments, or raises Unfusable."""
    return Program(call, given)


class Program:
    """The layer table of one call of the routed module, and the steps before and behind it.

    Args:
        call: The call, which runs with the parameters of the first cell.
        given: The rows of the arguments, for ``ROWS`` samples.

    Raises:
        Unfusable: For a step that is no such network, or that cannot be done again for other samples.
    """

    name, why = "fused", ""

    def __init__(self, call: Call, given: list[Tensor]) -> None:
        self._module = call.module
        trace = Trace(call, given)
        self._n, self._inputs, self._parameters = trace.n, trace.inputs, trace.parameters
        self._result, self._outputs = trace.result, trace.outputs
        self._owned = [(owner, name) for owner, name, _ in owned_parameters(call.module)]
        if not all(isinstance(value, fx.Node) and value.meta["rows"] for value in self._outputs):
            raise Unfusable("a result depends on no sample")
        nodes = list(trace.graph.nodes)
        self._weights, self._before = (
            [node for node in nodes if node.op == "call_function" and node.meta["stage"] == stage]
            for stage in (CELLS, BEFORE)
        )
        self._writes = any(node.meta.get("inplace") for node in self._before)
        needed, returned = set(self._outputs), dict[fx.Node, list[Column]]()
        self._behind: list[fx.Node] = []
        for node in reversed(nodes):
            stage, writes = node.meta["stage"], node.meta.get("inplace")
            if stage not in (LAYERS, BEHIND) or not (node in needed or (stage == BEHIND and writes)):
                continue
            columns = trace.features(node) if stage == LAYERS else []
            if columns:
                returned[node] = columns
            else:  # what moves columns of several layers is done again, too
                self._behind.insert(0, node)
                needed.update(node.all_input_nodes)
        self._make_table(trace, returned)
        for node in nodes:
            node.meta.pop("value", None)

    def _make_table(self, trace: Trace, returned: dict[fx.Node, list[Column]]) -> None:
        """The table of the layers that some values come from. Layers read others, and blocks of values, whole."""
        if not returned:
            raise Unfusable("nothing that is returned comes from a layer")
        parts = {}
        for li in _sources([columns[0] for columns in returned.values()], Linear):
            parts[li] = li.part([i for columns in returned.values() for source, i in columns if source is li])
        used, layers = set(parts.values()), list(dict.fromkeys([*trace.layers, *parts.values()]))
        for layer in reversed(layers):
            used.update(_sources(layer.inputs, Linear) if layer in used else ())
        self._layers = [layer for layer in layers if layer in used]
        reads = [_sources(layer.inputs, fx.Node) for layer in self._layers]
        first = next((read for read in reads if read), [])
        others = [value for value in dict.fromkeys(itertools.chain(*reads)) if value not in first]
        if not first:
            raise Unfusable("no layer reads the samples")
        self._blocks = [first, others] if others else [first]
        widths: dict[int | str, int] = {number: layer.width for number, layer in enumerate(self._layers)}
        places: dict[Linear | fx.Node, tuple[int | str, int]] = {layer: (i, 0) for i, layer in enumerate(self._layers)}
        for name, block in zip((POSITIONS, DIRECTIONS), self._blocks):
            for value in block:
                places[value] = name, widths.get(name, 0)
                widths[name] = widths.get(name, 0) + value.meta["value"].shape[1:].numel()
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
        self._values = []  # with their shapes, and the columns of raw outputs that make them
        for value, ((source, i), *more) in returned.items():
            start = begins[source] + i
            self._values.append((value, value.meta["value"].shape[1:], start, start + 1 + len(more)))

    # Running ----------------------------------------------------------------------------------------------------------

    def run(self, call: Call, grouping: Grouping) -> Results:
        """The method's results, in the order of the call, but for entries and placeholders."""
        order = grouping if grouping.rows is not None or not call.layout.n else None
        inputs, owned = call.arranged(order), self._owned
        if call.module is not self._module:  # a copy of the module, with parameters of its own
            owned = [(owner, name) for owner, name, _ in owned_parameters(call.module)]
        n = inputs[0].shape[0]
        values: dict[fx.Node, Any] = {self._n: n}
        values.update(zip(self._inputs, [x.clone() for x in inputs] if self._writes else inputs))
        for node, place in self._parameters.items():
            owner, name = owned[place]
            values[node] = owner._parameters[name]
        _run(self._before, values)
        blocks = [_joined([values[value].reshape(n, -1) for value in block]).contiguous() for block in self._blocks]
        weights, biases = self._stacked(values, grouping.k)
        where = grouping.where if grouping.rows is None else {"cells": grouping.sorted_cells.int()}
        directions = blocks[1] if len(blocks) > 1 else None
        raw, cells = routed_mlp(
            blocks[0], weights, biases, layers=self._table, directions=directions, backend=grouping.backend, **where
        )
        if where and grouping.rows is None:
            grouping.where = {"cells": cells}
        for value, shape, start, stop in self._values:
            values[value] = raw[:, start:stop].reshape(n, *shape)
        _run(self._behind, values)
        return Results(self._result, [values[value] for value in self._outputs], order)

    def _stacked(self, values: dict[fx.Node, Any], k: int) -> tuple[list[Tensor], list[Tensor | None]]:
        """Weights [k, o, i] and biases [k, o] of the table, in its order."""

        def of_cells(node: fx.Node) -> Any:
            value = values[node]
            return value if node.meta["stage"] == CELLS else value.expand(k, *value.shape)

        for node in self._weights:
            args, kwargs = map_arg((node.args, node.kwargs), lambda node: map_tensors(of_cells(node), PerCell))
            made = args[0][args[1]] if node.target is operator.getitem else for_all_cells(node.target, args, kwargs)
            values[node] = map_tree(made, lambda _, own, nested: own.stacked if isinstance(own, PerCell) else own)
        weights: list[Tensor] = []
        biases: list[Tensor | None] = []
        for layer, order in zip(self._layers, self._orders, strict=True):
            weight, bias = of_cells(layer.weight), None if layer.bias is None else of_cells(layer.bias)
            if layer.width < weight.shape[1]:
                weight = weight[:, layer.start : layer.start + layer.width]
                bias = None if bias is None else bias[:, layer.start : layer.start + layer.width]
            if order is not None:
                weight = weight.new_zeros(*weight.shape[:2], order[1]).index_add(2, order[0].to(weight.device), weight)
            plain = layer.factor == 1
            weights.append(weight if plain else weight * layer.factor)
            biases.append(bias if plain or bias is None else bias * layer.factor)
        return weights, biases


def _run(nodes: list[fx.Node], values: dict[fx.Node, Any]) -> None:
    """Calls the functions of some nodes in turn."""
    for node in nodes:
        args, kwargs = map_arg((node.args, node.kwargs), values.__getitem__)
        result = node.target(*args, **kwargs)  # type: ignore[operator]
        values[node] = args[0] if node.meta.get("inplace") else result


def _sources(columns: Iterable[Column], kind: type[Any]) -> list[Any]:
    """Layers, or values, that columns belong to, each once."""
    return list(dict.fromkeys(source for source, _ in columns if isinstance(source, kind)))


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)
