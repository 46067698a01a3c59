"""One call of a module as a graph of functions, and the linear layers in it.

The number of samples is one that no other size is a multiple of. Every function is put in its place on the way: among
those of parameters alone, before the first layer (encodings), among the layers (activations, and what moves columns),
or behind them (activations of heads, dicts). A column is a feature of a value from before the layers, or of a layer.
"""

from __future__ import annotations

import contextlib
import operator
import threading
import types
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor, fx
from torch.fx.node import map_aggregate, map_arg
from torch.overrides import TorchFunctionMode

from voronerf.router.double import Double
from voronerf.router.grouped import METADATA, RANDOM, find, name_of, user_line, writes_in_place
from voronerf.router.grouping import cell_parameters, owned_parameters
from voronerf.router.layout import Call, rebuild, tensors_of

ROWS = 37  # in a trace
CELLS, BEFORE, LAYERS, BEHIND = range(4)  # stages: of cells' parameters alone, before the layers, among, behind them
_PATCHES = threading.RLock()  # one thread at a time changes what torch calls for a custom function
_ROW_CODES = torch.arange(ROWS)[:, None] << 32  # apart by more than there are columns
_ACTIVATIONS = {
    "relu": find("relu relu_", F, torch, torch.Tensor),
    "sigmoid": find("sigmoid sigmoid_", F, torch, torch.Tensor),
    "sine": find("sin sin_", torch, torch.Tensor),
    "softplus": find("softplus", F),
}
_PRODUCTS = (torch.mul, torch.multiply, torch.Tensor.mul, torch.Tensor.__mul__, torch.Tensor.__rmul__)
_MOVERS = find(
    """
    cat concat concatenate hstack dstack stack split chunk tensor_split unbind __getitem__ narrow select index_select
    permute transpose swapaxes swapdims movedim moveaxis reshape view view_as reshape_as flatten unflatten unsqueeze
    squeeze expand expand_as broadcast_to contiguous clone repeat tile flip roll
    """,
    torch,
    torch.Tensor,
)
"""What may move columns without changing them."""


class Unfusable(Exception):
    """A module is not a network that a layer table describes; the message says where."""


@dataclass(eq=False)
class Linear:
    """Features of a linear layer of the trace, and an activation of so many times their sums."""

    weight: fx.Node
    bias: fx.Node | None
    inputs: list[Column]
    width: int
    start: int = 0  # of the features among those of the weight
    activation: str = "none"
    factor: float = 1.0

    def part(self, features: list[int]) -> Linear:
        """The least range of its features that holds some of them."""
        start, width = min(features), max(features) + 1 - min(features)
        return self if width == self.width else replace(self, start=start, width=width)


Column = tuple[Linear | fx.Node, int]  # a layer or a value, and which of its columns


class Trace(TorchFunctionMode):
    """Takes down the functions that the routed module calls with its first cell's parameters.

    The ``meta`` of a node has its ``value``, its ``stage``, whether it depends on the samples (``rows``), its ``line``
    in the module, and whether it is its first argument, written to (``inplace``).

    Raises:
        Unfusable: For a step that is no part of such a network, or that cannot be done again for other samples.
    """

    def __init__(self, call: Call, given: list[Tensor]) -> None:
        super().__init__()
        module = call.module
        single = {id(p): p.detach()[0].requires_grad_(p.requires_grad) for p in cell_parameters(module)}
        self._of_cells = set(map(id, single.values()))
        self._places = {id(single.get(id(p), p)): i for i, (_, _, p) in enumerate(owned_parameters(module))}
        self.graph = fx.Graph()
        self.parameters: dict[fx.Node, int] = {}  # with their place among ``owned_parameters``
        self.layers: list[Linear] = []
        self._running = False
        self._nodes: dict[int, fx.Node] = {}  # by the id of their tensor, which ``meta`` keeps
        self._codes: dict[fx.Node, Tensor] = {}  # like each value, with the number of its column in each entry
        self._columns: list[Column] = []
        self._first: dict[Linear | fx.Node, int] = {}  # where the columns of a layer or value begin among these
        self.n = self._new(ROWS)
        self.inputs = [self._new(tensor) for tensor in given]
        double = Double(module)
        with _custom_functions(self), self:
            result = double.run(call, given, single)
        self.result = rebuild(result, [tensor.detach() for tensor in tensors_of(result)])
        self.outputs = [self._argument(tensor) for tensor in tensors_of(result)]

    def _new(self, value: Any, node: fx.Node | None = None, rows: bool = True, stage: int = BEFORE) -> fx.Node:
        """The node of a value; without one it is an input of the graph."""
        node = self.graph.placeholder("given") if node is None else node
        node.meta.update(value=value, rows=rows, stage=stage)
        if isinstance(value, Tensor):
            self._nodes[id(value)] = node
            if rows and not any(size and size % ROWS == 0 for size in value.shape):
                shape = list(value.shape)
                raise Unfusable(f"a tensor of shape {shape} has no row for each of {ROWS} samples{user_line()}")
        return node

    def _argument(self, value: Any) -> Any:
        """What stands for an argument in the graph."""
        if type(value) is int and value and value % ROWS == 0:
            return self._new(value, self.graph.call_function(operator.mul, (self.n, value // ROWS)))
        if not isinstance(value, Tensor) or id(value) in self._nodes:
            return self._nodes.get(id(value), value)
        if id(value) in self._places:
            node = self._new(value, rows=False, stage=CELLS if id(value) in self._of_cells else BEFORE)
            self.parameters[node] = self._places[id(value)]
            return node
        if value.requires_grad or value.shape[:1] == (ROWS,):
            raise Unfusable(f"a tensor comes from what is no PyTorch function{user_line()}")
        return value

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self.follow(func, args, kwargs or {})

    def follow(self, func: Any, args: Any, kwargs: Any) -> Any:
        """Calls a function and takes it down."""
        if self._running or func in METADATA:
            return func(*args, **kwargs)
        node = self.graph.call_function(func, *map_aggregate((args, kwargs), self._argument))
        node.meta["inplace"] = inplace = writes_in_place(func) or bool(kwargs.get("inplace"))
        node.meta["line"], operands = user_line(), tensors_of((args, kwargs))
        self._running = True  # what it calls itself is part of it
        try:
            result = func(*args, **kwargs)
        finally:
            self._running = False
        found = operands[:1] if inplace else tensors_of(result)
        used = node.all_input_nodes
        idle = func is F.dropout and not (kwargs["training"] and kwargs["p"])
        for refused, does in ((func in RANDOM and not idle, "draws random numbers"), (not found, "reads values")):
            if refused and used and result is not None:
                raise Unfusable(f"{name_of(func)} {does}{node.meta['line']}")
        if not used or not found or (not inplace and any(result is tensor for tensor in operands)):
            self.graph.erase_node(node)
            return result
        nodes, rows = [node], any(value.meta["rows"] for value in used)
        if not inplace and not isinstance(result, Tensor):
            nodes = [self.graph.call_function(operator.getitem, (node, i)) for i in range(len(found))]
        for value, tensor in zip(nodes, found, strict=True):
            self._new(tensor, value, rows)
        stage = self._stage(node, used, nodes, rows)
        for value in (node, *nodes):
            value.meta["stage"] = stage
        return result

    def _stage(self, node: fx.Node, used: list[fx.Node], results: list[fx.Node], rows: bool) -> int:
        """Where a function belongs that uses some nodes."""
        stages = {value.meta["stage"] for value in used}
        stage, by_parameters = max(stages), any(not value.meta["rows"] for value in used)
        # A layer that all cells share, on what is no layer's, is part of an encoding.
        if rows and node.target is F.linear and by_parameters and (CELLS in stages or stage == LAYERS):
            self._add_layer(node)
            return LAYERS
        if CELLS in stages:
            if rows:
                raise Unfusable(f"parameters meet samples in {name_of(node.target)}{node.meta['line']}")
            return CELLS
        if stage == BEFORE:
            return BEFORE
        moves = stage == LAYERS and not by_parameters and self._move(node, results)
        return LAYERS if moves or (not by_parameters and self._activate(node, used)) else BEHIND

    def _add_layer(self, node: fx.Node) -> None:
        given: dict[str, Any] = {"bias": None, **dict(zip(("input", "weight", "bias"), node.args)), **node.kwargs}
        source, weight, bias = (given[name] for name in ("input", "weight", "bias"))
        values = [(source, True), (weight, False), *[(bias, False)] * (bias is not None)]
        if any(not isinstance(value, fx.Node) or value.meta["rows"] is not rows for value, rows in values):
            raise Unfusable(f"a layer has weights or inputs that are neither parameters nor samples{node.meta['line']}")
        if source.meta["stage"] == BEHIND:
            step = source.args[0] if source.target is operator.getitem else source
            name = f"{name_of(step.target)}{step.meta['line']}"
            raise Unfusable(f"a layer reads the result of {name}, which is no activation or arrangement of a table")
        shape = source.meta["value"].shape
        if shape[0] != ROWS or shape[:-1].numel() != ROWS:
            raise Unfusable(f"a layer runs on other than one row for each sample{node.meta['line']}")
        self.layers.append(Linear(weight, bias, self.columns(source), node.meta["value"].shape[-1]))
        self._coded(node, self.layers[-1])

    def _activate(self, node: fx.Node, used: list[fx.Node]) -> bool:
        """Has the columns of one layer go through an activation; ``sin(factor * layer)`` is one."""
        name = next((name for name, functions in _ACTIVATIONS.items() if node.target in functions), None)
        rest = node.args[1:], {key: value for key, value in node.kwargs.items() if key != "inplace"}
        if name is None or (name == "softplus" and rest not in (((), {}), ((1, 20), {}), ((), {"beta": 1}))):
            return False
        source, factor = used[0], 1.0
        numbers = [item for item in source.args if isinstance(item, (int, float))]
        if name == "sine" and source.target in _PRODUCTS and numbers:
            source, factor = source.all_input_nodes[0], numbers[0]
        columns = self.columns(source) if source.meta["stage"] == LAYERS else [(source, 0)]
        layer = columns[0][0]
        if not isinstance(layer, Linear) or layer.activation != "none" or any(own is not layer for own, _ in columns):
            return False
        self.layers.append(replace(layer, activation=name, factor=factor))
        shift = self._number(self.layers[-1], layer.width) - self._first[layer]
        self._codes[node] = self._codes[source] + shift
        return True

    def _move(self, node: fx.Node, results: list[fx.Node]) -> bool:
        """Runs a function that may only move columns on the numbers of the columns, and reads where they went."""
        if node.target not in _MOVERS:
            return False
        try:
            args, kwargs = map_arg((node.args, node.kwargs), self._coded)
            moved = dict(zip(results, tensors_of(node.target(*args, **kwargs)), strict=True))  # type: ignore[operator]
        except Exception:
            return False
        for value, codes in moved.items():
            if codes.shape != value.meta["value"].shape or len(codes) != ROWS or codes.dtype != torch.int64:
                return False
            if not torch.equal(codes.reshape(ROWS, -1), codes[:1].reshape(1, -1) + _ROW_CODES):
                return False
        self._codes.update(moved)
        return True

    def _number(self, source: Linear | fx.Node, width: int) -> int:
        """Numbers the columns of a layer or of a value from before the layers, and gives the first number."""
        first = self._first[source] = len(self._columns)
        self._columns += [(source, i) for i in range(width)]
        return first

    def _coded(self, node: fx.Node, layer: Linear | None = None) -> Any:
        """The numbers of a value's columns, [ROWS, ...], each with that of its row; a number of samples as it is."""
        if isinstance(node.meta["value"], int):
            return node.meta["value"]
        if node not in self._codes:
            shape = node.meta["value"].shape
            assert shape[0] == ROWS
            width = shape[1:].numel()
            first = self._number(node if layer is None else layer, width)
            self._codes[node] = (torch.arange(first, first + width) + _ROW_CODES).reshape(shape)
        return self._codes[node]

    def columns(self, node: fx.Node) -> list[Column]:
        """What the columns of a value are."""
        return [self._columns[code] for code in self._coded(node)[:1].flatten().tolist()]

    def features(self, node: fx.Node) -> list[Column]:
        """The columns of a value that are features of one layer next to each other; none of another."""
        columns = self.columns(node) if node in self._codes else []
        layer, first = columns[0] if columns else (node, 0)
        return columns if columns == [(layer, first + i) for i in range(len(columns))] and layer in self.layers else []


@contextlib.contextmanager
def _custom_functions(trace: Trace) -> Iterator[None]:
    """Shows a trace the custom functions of this thread, which no mode sees."""
    here = threading.get_ident()
    with _PATCHES:
        own = torch.autograd.Function.apply.__func__  # type: ignore[attr-defined]

        def apply(cls: Any, *args: Any, **kwargs: Any) -> Any:
            function = types.MethodType(own, cls)
            return function(*args, **kwargs) if threading.get_ident() != here else trace.follow(function, args, kwargs)

        with mock.patch.object(torch.autograd.Function, "apply", classmethod(apply)):
            yield
