"""What a module does with the rows of one call, as a list of steps: functions of rows, and functions of parameters.

A row count that no other size is a multiple of tells the number of samples from other numbers.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from voronerf.router.grouped import METADATA, name_of, user_line, writes_in_place
from voronerf.router.layout import Call
from voronerf.router.loop import RANDOM, Given
from voronerf.router.parameters import cell_parameters, in_place_of_parameters, owned_parameters
from voronerf.router.trees import rebuild, tensors_of

ROWS = 37  # in a trace
_APPLY = torch.autograd.Function.apply.__func__.__code__  # type: ignore[attr-defined]
_ACTIVATIONS: dict[str, set[Any]] = {
    "relu": {F.relu, torch.relu, torch.relu_, torch.Tensor.relu, torch.Tensor.relu_, F.relu_},
    "sigmoid": {torch.sigmoid, torch.Tensor.sigmoid, F.sigmoid, torch.sigmoid_, torch.Tensor.sigmoid_},
    "sine": {torch.sin, torch.Tensor.sin, torch.sin_, torch.Tensor.sin_},
    "softplus": {F.softplus},
}
_PRODUCTS = (torch.mul, torch.multiply, torch.Tensor.mul, torch.Tensor.__mul__, torch.Tensor.__rmul__)


class Unfusable(Exception):
    """A module is not a network that a layer table describes; the message says where."""


@dataclass(frozen=True)
class Ref:
    """A value, in the place of its tensor."""

    value: int


@dataclass(frozen=True)
class Rows:
    """A number that is ``each`` times that of the samples."""

    each: int


@dataclass(eq=False)
class Step:
    """One function of rows or of parameters.

    Attributes:
        function: Of PyTorch, or a custom ``autograd.Function``'s ``apply``.
        args: With a Ref in the place of each tensor of rows or parameter, and Rows in that of its number.
        kwargs: Likewise.
        values: Numbers of its results, in order.
        inplace: Whether it writes to its first argument, which then goes on as the first of ``values``.
        line: Where it stands in the module.
    """

    function: Any
    args: Any
    kwargs: Any
    values: list[int]
    inplace: bool = False
    line: str = ""

    def refs(self) -> list[int]:
        """The values among its arguments."""
        found: list[int] = []
        map_arguments((self.args, self.kwargs), lambda v: found.append(v.value) if isinstance(v, Ref) else None)
        return found

    def run(self, values: dict[int, Any], n: int) -> None:
        """Does the step again, for n rows."""

        def fill(item: Any) -> Any:
            if isinstance(item, Ref):
                return values[item.value]
            return item.each * n if isinstance(item, Rows) else item

        args, kwargs = map_arguments((self.args, self.kwargs), fill)
        result = self.function(*args, **kwargs)
        if self.inplace:
            values[self.values[0]] = args[0]
        else:
            values.update(zip(self.values, tensors_of(result), strict=True))


@dataclass
class Trace:
    """The steps of a call.

    Attributes:
        inputs: How many values are inputs, in the order of the arguments.
        steps: In order.
        sizes: Of every value of rows, rows for each sample and the dimensions behind; None for one of parameters.
        parameters: Values that are parameters, with their owner in the routed module and their name.
        result: What the module returned, for its structure.
        outputs: For each tensor of the result a Ref, or the tensor where it depends on no sample.
    """

    inputs: int = 0
    steps: list[Step] = field(default_factory=list)
    sizes: list[tuple[int, ...] | None] = field(default_factory=list)
    parameters: dict[int, tuple[nn.Module, str]] = field(default_factory=dict)
    result: Any = None
    outputs: list[Any] = field(default_factory=list)


def map_arguments(value: Any, change: Callable[[Any], Any]) -> Any:
    """Arguments of a function with every entry of lists, tuples, dicts and slices changed."""
    if isinstance(value, (list, tuple)):
        items = [map_arguments(item, change) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else items if isinstance(value, list) else tuple(items)
    if isinstance(value, dict):
        return {key: map_arguments(item, change) for key, item in value.items()}
    if isinstance(value, slice):
        return slice(*[map_arguments(item, change) for item in (value.start, value.stop, value.step)])
    return change(value)


def trace_call(original: nn.Module, module: nn.Module, call: Call, given: Given) -> Trace:
    """Follows one call of a copy of the routed module, with the parameters of its first cell, for ``ROWS`` samples.

    Raises:
        Unfusable: For a step that cannot be done again for other samples.
    """
    single = {id(p): p.detach()[0].requires_grad_(p.requires_grad) for _, _, p in cell_parameters(module)}
    places = {}
    for (owner, name, _), (_, _, parameter) in zip(owned_parameters(original), owned_parameters(module), strict=True):
        places[id(single.get(id(parameter), parameter))] = (owner, name)
    buffers = {id(own): other for own, other in zip(module.buffers(), original.buffers(), strict=True)}
    recorder = _Recorder(places, buffers)
    for tensor in given.rows:
        recorder.new(tensor)
    recorder.trace.inputs = len(given.rows)
    with in_place_of_parameters(module, single), recorder:
        result = call.function(module)(*given.args, **given.kwargs)
    recorder.trace.outputs = [recorder.ref(tensor) for tensor in tensors_of(result)]
    recorder.trace.result = rebuild(result, [tensor.detach() for tensor in tensors_of(result)])
    return recorder.trace


class _Recorder(TorchFunctionMode):
    """Takes down the functions that a module calls."""

    def __init__(self, places: dict[int, tuple[nn.Module, str]], buffers: dict[int, Tensor]) -> None:
        super().__init__()
        self.trace = Trace()
        self._places, self._buffers = places, buffers
        self._grad = torch.is_grad_enabled()
        self._known: dict[int, tuple[Tensor, int]] = {}
        self._frame: Any = None  # of a custom function's apply
        self._inner: dict[int, tuple[Tensor, Step]] = {}

    def new(self, tensor: Tensor, rows: bool = True) -> int:
        """Numbers a value."""
        number = len(self.trace.sizes)
        self._known[id(tensor)] = (tensor, number)  # kept, so that no other tensor gets its id
        sizes = (tensor.shape[0] // ROWS, *tensor.shape[1:]) if rows and tensor.dim() else None
        self.trace.sizes.append(sizes)
        if rows and (sizes is None or not sizes[0] or tensor.shape[0] % ROWS):
            raise Unfusable(
                f"a tensor of shape {list(tensor.shape)} has no row for each of {ROWS} samples{user_line()}"
            )
        return number

    def ref(self, value: Any) -> Any:
        """What stands for an argument in a step."""
        if isinstance(value, int) and not isinstance(value, bool) and value and value % ROWS == 0:
            return Rows(value // ROWS)
        if not isinstance(value, Tensor):
            return value
        if id(value) in self._inner and id(value) not in self._known:
            step = self._inner[id(value)][1]
            if step.values:
                raise Unfusable(f"{name_of(step.function)} has more than one result{step.line}")
            step.values.append(self.new(value, self._depends_on_rows(step)))
        if id(value) in self._known:
            return Ref(self._known[id(value)][1])
        if id(value) in self._places:
            number = self.new(value, rows=False)
            self.trace.parameters[number] = self._places[id(value)]
            return Ref(number)
        if id(value) in self._buffers:
            return self._buffers[id(value)]
        if value.requires_grad or value.shape[:1] == (ROWS,):
            raise Unfusable(f"a tensor comes from what is no PyTorch function{user_line()}")
        return value

    def _depends_on_rows(self, step: Step) -> bool:
        found: list[Any] = []
        map_arguments((step.args, step.kwargs), found.append)
        return any(
            isinstance(item, Rows) or (isinstance(item, Ref) and self.trace.sizes[item.value] is not None)
            for item in found
        )

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in METADATA:
            return func(*args, **kwargs)
        frame = _custom_function()
        if frame is not None:
            return self._inside(frame, func, args, kwargs)
        given = map_arguments((args, kwargs), self.ref)
        step = Step(func, given[0], given[1], [], line=user_line())
        operands = tensors_of((args, kwargs))
        result = func(*args, **kwargs)
        found = tensors_of(result)
        if not step.refs() and not self._depends_on_rows(step):
            return result
        if torch.is_grad_enabled() != self._grad:
            raise Unfusable(f"the gradient mode changes{step.line}")
        idle = func is F.dropout and not (kwargs["training"] and kwargs["p"])
        if func in RANDOM and not idle:
            raise Unfusable(f"{name_of(func)} draws random numbers{step.line}")
        if func is torch.autograd.grad:
            raise Unfusable(f"gradients are taken{step.line}")
        step.inplace = writes_in_place(func) or bool(kwargs.get("inplace"))
        if isinstance(kwargs.get("out"), Tensor):
            raise Unfusable(f"{name_of(func)} writes to out={step.line}")
        if not found and not step.inplace:
            if result is None:
                return result
            raise Unfusable(f"{name_of(func)} reads values{step.line}")
        if not step.inplace and any(result is tensor for tensor in operands):
            return result
        rows = self._depends_on_rows(step)
        for tensor in [operands[0]] if step.inplace else found:
            step.values.append(self.new(tensor, rows))
        self.trace.steps.append(step)
        return result

    def _inside(self, frame: Any, func: Any, args: Any, kwargs: Any) -> Any:
        """A function within a custom function's ``forward``: the custom function is the step."""
        if frame is not self._frame:
            self._frame = frame
            given = map_arguments(frame.f_locals["args"], self.ref)
            step = Step(frame.f_locals["cls"].apply, given, {}, [], line=user_line())
            self.trace.steps.append(step)
        result = func(*args, **kwargs)
        for tensor in tensors_of(result):
            self._inner[id(tensor)] = (tensor, self.trace.steps[-1])
        return result


def _custom_function() -> Any:
    """The frame of the outermost ``autograd.Function.apply`` that is under way, or None."""
    frame, found = inspect.currentframe(), None
    while frame is not None and frame.f_code is not trace_call.__code__:
        found = frame if frame.f_code is _APPLY else found
        frame = frame.f_back
    return found


def activation_of(step: Step) -> str | None:
    """The name that a layer table has for a step's function, or None."""
    rest = (step.args[1:], {key: value for key, value in step.kwargs.items() if key != "inplace"})
    for name, functions in _ACTIVATIONS.items():
        if step.function in functions:
            plain = rest in (((), {}), ((1, 20), {}), ((1.0, 20.0), {}), ((), {"beta": 1}))
            return name if name != "softplus" or plain else None
    return None


def with_scales(trace: Trace) -> list[Step]:
    """The steps of a trace, with the factor of ``sin(factor * layer(x))`` in the layer."""
    steps = list(trace.steps)
    uses: dict[int, int] = {}
    for step in steps:
        for ref in step.refs():
            uses[ref] = uses.get(ref, 0) + 1
    for item in trace.outputs:
        if isinstance(item, Ref):
            uses[item.value] = uses.get(item.value, 0) + 1
    made = {value: step for step in steps for value in step.values}
    for step in list(steps):
        refs = step.refs()
        factors = [item for item in step.args if isinstance(item, (int, float)) and not isinstance(item, bool)]
        source = made.get(refs[0]) if len(refs) == 1 else None
        if step.function not in _PRODUCTS or len(factors) != 1 or len(step.args) != 2 or source is None:
            continue
        wave = next((s for s in steps if refs and step.values[0] in s.refs()), None)
        once = uses.get(refs[0]) == 1 and uses.get(step.values[0]) == 1
        if source.function is F.linear and once and wave is not None and activation_of(wave) == "sine":
            linear = replace(source, values=step.values, kwargs={**source.kwargs, "scale": factors[0]})
            steps[steps.index(source)] = linear
            steps.remove(step)
            made[step.values[0]] = linear
    return steps
