"""One call of a module, taken down as linear layers and steps before, among and behind them.

The number of samples is one that no other size is a multiple of. Every function is put in its place on the way: before
the first layer (encodings), among the layers (activations, and what moves columns), or behind them (activations of
heads, dicts). A column is a feature of a value from before the layers, or of a layer.
"""

from __future__ import annotations

import contextlib
import threading
import types
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode

from voronerf.router.grouped import METADATA, RANDOM, find, name_of, user_line, writes_in_place
from voronerf.router.grouping import cell_parameters, in_place_of_parameters, is_shared, owned_parameters
from voronerf.router.layout import Call, map_tree, rebuild, tensors_of

ROWS = 37  # in a trace
_PATCHES = threading.RLock()  # one thread at a time changes what torch calls for a custom function
_BEFORE, TABLE, _BEHIND = range(3)  # where a value comes from
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


class Ref(int):
    """The number of a value, in the place of its tensor."""


class Rows(int):
    """How many times a number is that of the samples, in its place."""


@dataclass(eq=False)
class Step:
    """One function of rows or of parameters."""

    function: Any  # of PyTorch, or a custom ``autograd.Function``'s ``apply``
    given: Any  # its args and kwargs, with what stands for tensors of rows, parameters, and their number
    refs: list[Ref]  # the values among these
    values: list[int]  # the numbers of its results, in order
    inplace: bool  # it writes to its first argument, which then goes on as the first of ``values``
    line: str  # where it stands in the module

    def run(self, values: dict[int, Any], n: int) -> None:
        """Does the step again, for n rows."""

        def fill(_: str, leaf: Any, nested: bool) -> Any:
            return values[leaf] if isinstance(leaf, Ref) else leaf * n if isinstance(leaf, Rows) else leaf

        args, kwargs = map_tree(self.given, fill)
        result = self.function(*args, **kwargs)
        values.update(zip(self.values, [args[0]] if self.inplace else tensors_of(result), strict=True))

    def activation(self) -> str | None:
        """The name that a layer table has for its function, or None."""
        args, kwargs = self.given
        rest = (args[1:], {key: value for key, value in kwargs.items() if key != "inplace"})
        name = next((name for name, functions in _ACTIVATIONS.items() if self.function in functions), None)
        plain = rest in (((), {}), ((1, 20), {}), ((), {"beta": 1}))
        return name if name != "softplus" or plain else None


@dataclass(eq=False)
class Linear:
    """Features of a linear layer of the trace, and an activation of so many times their sums."""

    weight: int  # the values of its parameters
    bias: int | None
    inputs: list[Column]
    width: int
    start: int = 0  # of the features among those of the weight
    activation: str = "none"
    factor: float = 1.0

    def part(self, features: list[int], **changes: Any) -> Linear:
        """The least range of its features that holds some of them."""
        start, width = min(features), max(features) + 1 - min(features)
        same = width == self.width and not changes
        return self if same else replace(self, start=self.start + start, width=width, **changes)


Column = tuple[Linear | int, int]  # a layer or the number of a value, and which of its columns


class Trace(TorchFunctionMode):
    """Takes down the functions that the routed module calls with its first cell's parameters."""

    def __init__(self, call: Call, given: list[Tensor]) -> None:
        super().__init__()
        module = call.module
        self.values: list[Tensor] = []  # kept, so that no other tensor gets the id of one
        self.stages: list[int] = []  # where every value comes from
        self.parameters: dict[int, int] = {}  # values that are parameters, with their place among ``owned_parameters``
        self.made: set[int] = set()  # values that are parameters, or made of them alone
        self.shared: set[int] = set()  # those among them that all cells have in common
        self.before: list[Step] = []
        self.behind: list[Step] = []
        self.weights: list[Step] = []  # of parameters of cells alone
        self.layers: list[Linear] = []
        single = {id(p): p.detach()[0].requires_grad_(p.requires_grad) for p in cell_parameters(module)}
        owned = owned_parameters(module)
        self._places = {id(single.get(id(parameter), parameter)): i for i, (_, _, parameter) in enumerate(owned)}
        self._in_common = {i for i, (owner, name, _) in enumerate(owned) if is_shared(owner, name)}
        self._running = False
        self._numbers: dict[int, int] = {}  # of values, by the id of their tensor
        self._codes: dict[int, Tensor] = {}  # like each value, with the number of its column in each entry
        self._columns: list[Column] = []
        self._first: dict[Linear | int, int] = {}  # where the columns of a layer or value begin among these
        self._scaled: dict[int, tuple[int, float]] = {}
        for tensor in given:
            self._new(tensor)
        with in_place_of_parameters(module, single), _custom_functions(self), self:
            result = call.run(given)
        self.result = rebuild(result, [tensor.detach() for tensor in tensors_of(result)])
        self.outputs = [self._ref(tensor) for tensor in tensors_of(result)]  # tensors where they depend on no sample

    def _new(self, tensor: Tensor, rows: bool = True) -> int:
        """Numbers a value."""
        if rows and not any(size and size % ROWS == 0 for size in tensor.shape):
            raise Unfusable(
                f"a tensor of shape {list(tensor.shape)} has no row for each of {ROWS} samples{user_line()}"
            )
        number = self._numbers[id(tensor)] = len(self.values)
        self.values.append(tensor)
        self.stages.append(_BEFORE)
        self.made |= set() if rows else {number}
        return number

    def _ref(self, value: Any) -> Any:
        """What stands for an argument in a step."""
        if isinstance(value, int) and not isinstance(value, bool) and value and value % ROWS == 0:
            return Rows(value // ROWS)
        if not isinstance(value, Tensor):
            return value
        if id(value) in self._places and id(value) not in self._numbers:
            number, place = self._new(value, rows=False), self._places[id(value)]
            self.parameters[number] = place
            self.shared |= {number} if place in self._in_common else set()
        if id(value) in self._numbers:
            return Ref(self._numbers[id(value)])
        if value.requires_grad or value.shape[:1] == (ROWS,):
            raise Unfusable(f"a tensor comes from what is no PyTorch function{user_line()}")
        return value

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self.follow(func, args, kwargs or {})

    def follow(self, func: Any, args: Any, kwargs: Any) -> Any:
        """Calls a function and takes it down."""
        if self._running or func in METADATA:
            return func(*args, **kwargs)
        leaves: list[Any] = []

        def stand_in(_: str, leaf: Any, nested: bool) -> Any:
            leaves.append(self._ref(leaf))
            return leaves[-1]

        given, inplace = map_tree((args, kwargs), stand_in), writes_in_place(func) or bool(kwargs.get("inplace"))
        step = Step(func, given, [leaf for leaf in leaves if isinstance(leaf, Ref)], [], inplace, user_line())
        operands = tensors_of((args, kwargs))
        self._running = True  # what it calls itself is part of the step
        try:
            result = func(*args, **kwargs)
        finally:
            self._running = False
        if not any(isinstance(leaf, (Ref, Rows)) for leaf in leaves):
            return result
        found = operands[:1] if step.inplace else tensors_of(result)
        idle = func is F.dropout and not (kwargs["training"] and kwargs["p"])
        for refused, does in ((func in RANDOM and not idle, "draws random numbers"), (not found, "reads values")):
            if refused and result is not None:
                raise Unfusable(f"{name_of(func)} {does}{step.line}")
        if not found or (not step.inplace and any(result is tensor for tensor in operands)):
            return result
        rows = any(isinstance(x, Rows) or (isinstance(x, Ref) and x not in self.made) for x in leaves)
        step.values = [self._new(tensor, rows) for tensor in found]
        self._place(step, rows)
        return result

    def _place(self, step: Step, rows: bool) -> None:
        stage = max((self.stages[ref] for ref in step.refs), default=_BEFORE)
        parameters = self.made.intersection(step.refs)
        in_common = parameters <= self.shared
        # A layer that all cells share, on what is no layer's, is part of an encoding.
        if rows and step.function is F.linear and parameters and not (in_common and stage != TABLE):
            self._add_layer(step)
        elif not in_common:
            if rows:
                raise Unfusable(f"parameters meet samples in {name_of(step.function)}{step.line}")
            self.weights.append(step)
        elif stage == _BEFORE:
            self.before.append(step)
            self.shared.update(() if rows else step.values)
        elif parameters or not (self._activate(step) or (stage == TABLE and self._move(step))):
            for value in step.values:
                self.stages[value] = _BEHIND
            self.behind.append(step)
            factor = next((item for item in step.given[0] if type(item) in (int, float)), None)
            if step.function in _PRODUCTS and factor is not None and stage == TABLE:
                self._scaled[step.values[0]] = (step.refs[0], factor)

    def _add_layer(self, step: Step) -> None:
        args, kwargs = step.given
        given = {"bias": None, **dict(zip(("input", "weight", "bias"), args)), **kwargs}
        source, weight, bias = (given[name] for name in ("input", "weight", "bias"))
        if source in self.made or not all(
            isinstance(v, Ref) and v in self.made for v in (weight, bias) if v is not None
        ):
            raise Unfusable(f"a layer has weights or inputs that are neither parameters nor samples{step.line}")
        if self.stages[source] == _BEHIND:
            earlier = next(s for s in self.behind if source in s.values)
            name = f"{name_of(earlier.function)}{earlier.line}"
            raise Unfusable(f"a layer reads the result of {name}, which is no activation or arrangement of a table")
        if self.values[source].shape[0] != ROWS or self.values[source].shape[:-1].numel() != ROWS:
            raise Unfusable(f"a layer runs on other than one row for each sample{step.line}")
        value = step.values[0]
        self.layers.append(Linear(weight, bias, self.columns(source), self.values[value].shape[-1]))
        self._coded(value, self.layers[-1])
        self.stages[value] = TABLE

    def _activate(self, step: Step) -> bool:
        """Has the columns of one layer go through an activation; ``sin(factor * layer)`` is one."""
        name, factor = step.activation(), 1.0
        if name is None or len(step.refs) != 1:
            return False
        source, value = int(step.refs[0]), step.values[0]
        if name == "sine":
            source, factor = self._scaled.get(source, (source, factor))
        columns = self.columns(source) if self.stages[source] == TABLE else [(-1, 0)]
        layer, features = columns[0][0], [feature for _, feature in columns]
        if not isinstance(layer, Linear) or layer.activation != "none" or any(own is not layer for own, _ in columns):
            return False
        self.layers.append(layer.part(features, activation=name, factor=factor))
        shift = self._number(self.layers[-1], self.layers[-1].width) - self._first[layer] - min(features)
        self._codes[value], self.stages[value] = self._codes[source] + shift, TABLE
        return True

    def _move(self, step: Step) -> bool:
        """Runs a function that may only move columns on the numbers of the columns, and reads where they went."""
        if step.function not in _MOVERS or step.inplace:
            return False
        try:
            moved: dict[int, Any] = {ref: self._coded(ref) for ref in step.refs}
            step.run(moved, ROWS)
        except Exception:
            return False
        for value in step.values:
            codes = moved[value]
            if codes.shape != self.values[value].shape or len(codes) != ROWS or codes.dtype != torch.int64:
                return False
            if not torch.equal(codes.reshape(ROWS, -1), codes[:1].reshape(1, -1) + _ROW_CODES):
                return False
        for value in step.values:
            self._codes[value], self.stages[value] = moved[value], TABLE
        return True

    def _number(self, source: Linear | int, width: int) -> int:
        """Numbers the columns of a layer or of a value from before the layers, and gives the first number."""
        first = self._first[source] = len(self._columns)
        self._columns += [(source, i) for i in range(width)]
        return first

    def _coded(self, value: int, layer: Linear | None = None) -> Tensor:
        """The numbers of a value's columns, [ROWS, ...], each with that of its row."""
        if value not in self._codes:
            shape = self.values[value].shape
            assert shape[0] == ROWS
            width = shape[1:].numel()
            first = self._number(value if layer is None else layer, width)
            self._codes[value] = (torch.arange(first, first + width) + _ROW_CODES).reshape(shape)
        return self._codes[value]

    def columns(self, value: int) -> list[Column]:
        """What the columns of a value are."""
        return [self._columns[code] for code in self._coded(value)[:1].flatten().tolist()]


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
