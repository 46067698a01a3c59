"""One call of a module, taken down as linear layers and steps before, among and behind them.

The number of samples is one that no other size is a multiple of. Every function is put in its place on the way: before
the first layer (encodings), among the layers (activations, and what moves columns), or behind them (activations of
heads, dicts).

Letters: n samples. A segment is a range of columns of a value from before the layers, or of a layer.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import threading
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from voronerf.router.grouped import METADATA, RANDOM, find, name_of, user_line, writes_in_place
from voronerf.router.grouping import cell_parameters, in_place_of_parameters, is_shared, owned_parameters
from voronerf.router.layout import Call, map_tree, rebuild, tensors_of

ROWS = 37  # in a trace
_PATCHES = threading.RLock()  # one thread at a time changes what torch calls for a custom function
_BEFORE, TABLE, _BEHIND = range(3)  # where a value comes from
_ROW_CODE = 1 << 32  # more than there are columns
_PLAIN = ("none", 1.0)
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


class Segment(NamedTuple):
    """Columns ``start`` to ``stop`` of a value, or of layer ``layer`` after an activation of so many times its sums."""

    value: int
    layer: int
    activation: tuple[str, float]
    start: int
    stop: int


@dataclass(eq=False)
class Linear:
    """A linear layer of the trace: the values of its parameters, and where its inputs come from."""

    weight: int
    bias: int | None
    inputs: tuple[Segment, ...]
    width: int


class Trace(TorchFunctionMode):
    """Takes down the functions that a copy of the routed module calls with its first cell's parameters."""

    def __init__(self, original: nn.Module, call: Call, given: list[Tensor]) -> None:
        super().__init__()
        module = call.module
        # Of every value of rows, rows for each sample and the dimensions behind, 0 rows where theirs is not the first;
        # None for one of parameters.
        self.sizes: list[tuple[int, ...] | None] = []
        self.stages: list[int] = []  # where every value comes from
        self.parameters: dict[int, int] = {}  # values that are parameters, with their place among ``owned_parameters``
        self.shared: set[int] = set()  # values that are parameters of all cells in common, or made of such alone
        self.before: list[Step] = []
        self.behind: list[Step] = []
        self.weights: list[Step] = []  # of parameters of cells alone
        self.layers: list[Linear] = []
        single = {id(p): p.detach()[0].requires_grad_(p.requires_grad) for p in cell_parameters(module)}
        owned = owned_parameters(module)
        self._places = {id(single.get(id(parameter), parameter)): i for i, (_, _, parameter) in enumerate(owned)}
        self._in_common = {i for i, (owner, name, _) in enumerate(owned) if is_shared(owner, name)}
        self._buffers = {id(own): other for own, other in zip(module.buffers(), original.buffers(), strict=True)}
        self._grad, self._running = torch.is_grad_enabled(), False
        self._known: dict[int, tuple[Tensor, int]] = {}
        self._codes: dict[int, Tensor] = {}  # like each value, with the number of its column in each entry
        self._columns: list[tuple[int, int, tuple[str, float], int]] = []  # as in a segment
        self._scaled: dict[int, tuple[int, float]] = {}
        for tensor in given:
            self._new(tensor)
        with in_place_of_parameters(module, single), _custom_functions(self), self:
            result = call.run(given)
        self.result = rebuild(result, [tensor.detach() for tensor in tensors_of(result)])
        self.outputs = [self._ref(tensor) for tensor in tensors_of(result)]  # tensors where they depend on no sample

    def _new(self, tensor: Tensor, rows: bool = True) -> int:
        """Numbers a value."""
        self._known[id(tensor)] = (tensor, len(self.sizes))  # kept, so that no other tensor gets its id
        if rows and not any(size and size % ROWS == 0 for size in tensor.shape):
            raise Unfusable(
                f"a tensor of shape {list(tensor.shape)} has no row for each of {ROWS} samples{user_line()}"
            )
        first = rows and tensor.shape[0] % ROWS == 0
        self.sizes.append((tensor.shape[0] // ROWS if first else 0, *tensor.shape[1:]) if rows else None)
        self.stages.append(_BEFORE)
        return len(self.sizes) - 1

    def _ref(self, value: Any) -> Any:
        """What stands for an argument in a step."""
        if isinstance(value, int) and not isinstance(value, bool) and value and value % ROWS == 0:
            return Rows(value // ROWS)
        if not isinstance(value, Tensor):
            return value
        if id(value) in self._places and id(value) not in self._known:
            number, place = self._new(value, rows=False), self._places[id(value)]
            self.parameters[number] = place
            self.shared |= {number} if place in self._in_common else set()
        if id(value) in self._known:
            return Ref(self._known[id(value)][1])
        if id(value) in self._buffers:
            return self._buffers[id(value)]
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
        idle = func is F.dropout and not (kwargs["training"] and kwargs["p"])
        found = operands[:1] if step.inplace else tensors_of(result)
        for refused, reason in (
            (torch.is_grad_enabled() != self._grad, "the gradient mode changes"),
            (func in RANDOM and not idle, "{} draws random numbers"),
            (func is torch.autograd.grad, "gradients are taken"),
            (not found and result is not None, "{} reads values"),
        ):
            if refused:
                raise Unfusable(f"{reason.format(name_of(func))}{step.line}")
        if not found or (not step.inplace and any(result is tensor for tensor in operands)):
            return result
        rows = any(isinstance(x, Rows) or (isinstance(x, Ref) and self.sizes[x] is not None) for x in leaves)
        step.values = [self._new(tensor, rows) for tensor in found]
        self._place(step, rows)
        return result

    def _place(self, step: Step, rows: bool) -> None:
        refs = step.refs
        stage = max((self.stages[ref] for ref in refs), default=_BEFORE)
        parameters = {ref for ref in refs if self.sizes[ref] is None}
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
        elif parameters or not (self._activate(step, refs) or (stage == TABLE and self._move(step, refs))):
            self.stages[step.values[0] : step.values[-1] + 1] = [_BEHIND] * len(step.values)
            self.behind.append(step)
            factor = next((item for item in step.given[0] if type(item) in (int, float)), None)
            if step.function in _PRODUCTS and factor is not None and stage == TABLE:
                self._scaled[step.values[0]] = (refs[0], factor)

    def _add_layer(self, step: Step) -> None:
        args, kwargs = step.given
        given = {"bias": None, **dict(zip(("input", "weight", "bias"), args)), **kwargs}
        source, weight, bias = (given[name] for name in ("input", "weight", "bias"))
        own = self.sizes[source] if isinstance(source, Ref) else None
        if own is None or not isinstance(weight, Ref) or self.sizes[weight] is not None:
            raise Unfusable(f"a layer has weights or inputs that are neither parameters nor samples{step.line}")
        if self.stages[source] == _BEHIND:
            earlier = next(s for s in self.behind if source in s.values)
            name = f"{name_of(earlier.function)}{earlier.line}"
            raise Unfusable(f"a layer reads the result of {name}, which is no activation or arrangement of a table")
        if math.prod(own[:-1]) != 1:
            raise Unfusable(f"a layer runs on other than one row for each sample{step.line}")
        out = self.sizes[step.values[0]]
        assert out is not None
        self.layers.append(Linear(weight, bias, self.segments(source), out[-1]))
        self._name(step.values[0], -1, len(self.layers) - 1, _PLAIN, 0)

    def _activate(self, step: Step, refs: list[Ref]) -> bool:
        """Has the columns of one layer go through an activation; ``sin(factor * layer)`` is one."""
        name = step.activation()
        if name is None or len(refs) != 1:
            return False
        source, factor = self._scaled.get(refs[0], (refs[0], 1.0)) if name == "sine" else (refs[0], 1.0)
        segments = self.segments(source) if self.stages[source] == TABLE else ()
        if len(segments) != 1 or segments[0].activation != _PLAIN or segments[0].layer < 0:
            return False
        self._name(step.values[0], -1, segments[0].layer, (name, factor), segments[0].start)
        return True

    def _move(self, step: Step, refs: list[Ref]) -> bool:
        """Runs a function that may only move columns on the numbers of the columns, and reads where they went."""
        if step.function not in _MOVERS or step.inplace:
            return False
        moved: dict[int, Any] = {ref: self._coded(ref) for ref in refs}
        try:
            step.run(moved, ROWS)
        except Exception:
            return False
        for value in step.values:
            m, *rest = self.sizes[value] or ()
            codes = moved[value]
            if codes.shape != (ROWS * m, *rest) or codes.dtype != torch.int64:
                return False
            by_row = codes.reshape(ROWS, -1)
            if not torch.equal(by_row, by_row[:1] + torch.arange(ROWS)[:, None] * _ROW_CODE):
                return False
        for value in step.values:
            self._codes[value], self.stages[value] = moved[value], TABLE
        return True

    def _name(self, value: int, source: int, layer: int, activation: tuple[str, float], start: int) -> None:
        """Numbers the columns of a value anew."""
        m, *rest = self.sizes[value] or ()
        width, first = m * math.prod(rest), len(self._columns)
        self._columns += [(source, layer, activation, start + i) for i in range(width)]
        codes = torch.arange(first, first + width) + torch.arange(ROWS)[:, None] * _ROW_CODE
        self._codes[value] = codes.reshape(ROWS * m, *rest)
        self.stages[value] = TABLE if layer >= 0 else _BEFORE

    def _coded(self, value: int) -> Tensor:
        if value not in self._codes:
            self._name(value, value, -1, _PLAIN, 0)
        return self._codes[value]

    def segments(self, value: int) -> tuple[Segment, ...]:
        """The columns of a value, in as few segments as possible."""
        m = (self.sizes[value] or (1,))[0]
        columns = [self._columns[code] for code in self._coded(value)[:m].flatten().tolist()]
        found = []
        for _, group in itertools.groupby(enumerate(columns), lambda pair: (pair[1][:3], pair[1][3] - pair[0])):
            run = [column for _, column in group]
            source, layer, activation, start = run[0]
            found.append(Segment(source, layer, activation, start, start + len(run)))
        return tuple(found)


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
