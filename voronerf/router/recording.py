"""What a module did with the rows of one call, as a list of steps that can be compared and done again.

n samples. A value is a tensor of rows, numbered in the order in which values appear; inputs come first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf.router.arguments import map_result, tensors_of
from voronerf.router.functions import RANDOM
from voronerf.router.grouping import PerCell
from voronerf.router.parameters import owned_parameters
from voronerf.router.rows import replace, tensors_in

Slot = tuple[nn.Module, str]


@dataclass(frozen=True)
class Ref:
    """A value, in the place of its tensor."""

    value: int


@dataclass
class Step:
    """One function of rows.

    Attributes:
        function: of PyTorch; None for a linear layer.
        args, kwargs: with a Ref in the place of each tensor of rows.
        values: numbers of its results, in order.
        layer: parameters of a linear layer, weight and bias or None.
        inplace: whether it writes to its first argument, which then goes on as the first of ``values``.
    """

    function: Any
    args: Any
    kwargs: dict[str, Any]
    values: list[int]
    layer: tuple[Slot, Slot | None] | None = None
    inplace: bool = False


@dataclass
class Program:
    """A recorded call.

    Attributes:
        inputs: how many values are inputs.
        steps: in order.
        sizes: of every value, the dimensions behind the rows, and rows for each sample in front of them.
        result: what the module returned, with a Ref in the place of each tensor.
        only_n: the number of samples, where a step was given it, or a number like it.
    """

    inputs: int
    steps: list[Step]
    sizes: list[tuple[int, ...]]
    result: Any = None
    only_n: int | None = None

    def same(self, other: Program) -> bool:
        """Whether another call took the same steps with the same constants."""
        if (self.inputs, self.sizes, len(self.steps)) != (other.inputs, other.sizes, len(other.steps)):
            return False
        if self.only_n != other.only_n:
            return False
        return _equal(self.result, other.result) and all(
            a.function == b.function
            and (a.layer, a.values, a.inplace) == (b.layer, b.values, b.inplace)
            and _equal(a.args, b.args)
            and _equal(a.kwargs, b.kwargs)
            for a, b in zip(self.steps, other.steps, strict=True)
        )


def _equal(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, Tensor):
        return a is b or (a.shape == b.shape and a.dtype == b.dtype and torch.equal(a, b))
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_equal(item, b[key]) for key, item in a.items())
    if isinstance(a, slice):
        return (a.start, a.stop, a.step) == (b.start, b.stop, b.step)
    return bool(a == b)


@dataclass
class Recorder:
    """Takes down the steps of one call, as :class:`voronerf.router.rows.RowMode` carries them out.

    Attributes:
        slots: parameters by the id of their stacked tensor.
        n: rows of the call.
        refused: why the call cannot be done again from its steps; empty if it can.
        program: the steps, once the call is over and can be done again.
    """

    slots: dict[int, Slot]
    n: int = 0
    refused: str = ""
    program: Program | None = None
    _program: Program = field(default_factory=lambda: Program(0, [], []))
    _modes: tuple[bool, torch.dtype | None] | None = None
    _known: dict[int, tuple[Tensor, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, module: nn.Module) -> Recorder:
        """A recorder for a module with stacked parameters."""
        return cls({id(parameter): (owner, name) for owner, name, parameter in owned_parameters(module)})

    def refuse(self, reason: str) -> None:
        """Notes that the call cannot be done again."""
        self.refused = self.refused or reason

    def _check_modes(self, value: Any) -> None:
        """Steps are done again under the modes of the call, and must not have had others."""
        kind = next((tensor.device.type for tensor in tensors_in(value)), "cpu")
        autocast = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else None
        modes = torch.is_grad_enabled(), autocast
        if self._modes is None:
            self._modes = modes
        if modes != self._modes:
            self.refuse("a change of gradient mode or autocast inside")

    def input(self, tensor: Tensor) -> None:
        """A tensor of rows among the module's arguments."""
        self._check_modes(tensor)
        self._new(tensor)
        self._program.inputs += 1

    def _new(self, tensor: Tensor) -> int:
        number = len(self._program.sizes)
        self._known[id(tensor)] = (tensor, number)  # kept, so that no other tensor gets its id
        self._program.sizes.append((tensor.shape[0] // self.n, *tensor.shape[1:]))
        return number

    def _ref(self, value: Any) -> Any:
        if isinstance(value, slice):
            replace((value.start, value.stop), self._ref)
        elif isinstance(value, torch.Size):
            replace(list(value), self._ref)
        elif isinstance(value, int) and not isinstance(value, bool) and value >= self.n and value % self.n == 0:
            self._program.only_n = self.n
        if not isinstance(value, Tensor):
            return value
        if id(value) in self._known:
            return Ref(self._known[id(value)][1])
        if value.requires_grad or value.shape[:1] == (self.n,):
            self.refuse("a tensor whose making was not seen")
        return value

    def linear(self, x: Tensor, weight: Tensor, bias: Tensor | None, result: Tensor) -> None:
        """A linear layer of rows whose parameters are the module's own."""
        self._check_modes(x)
        slots = [
            self.slots.get(id(parameter.stacked)) if isinstance(parameter, PerCell) else None
            for parameter in (weight, bias)
        ]
        if slots[0] is None or (bias is not None and slots[1] is None) or id(x) not in self._known:
            self.refuse("a layer whose weights are computed")
            return
        step = Step(None, (Ref(self._known[id(x)][1]),), {}, [], (slots[0], slots[1]))
        self._program.steps.append(step)
        step.values.append(self._new(result))

    def step(self, function: Any, args: Any, kwargs: dict[str, Any], result: Any, changed: list[Tensor]) -> None:
        """Any other function of rows."""
        self._check_modes(result)
        if function in RANDOM and not _idle_dropout(function, args, kwargs):
            self.refuse("random numbers")
        if isinstance(kwargs.get("out"), Tensor):
            self.refuse("out=")
        step = Step(function, replace(args, self._ref), replace(kwargs, self._ref), [], None, bool(changed))
        self._program.steps.append(step)
        for tensor in changed or tensors_in(result):
            step.values.append(self._new(tensor))

    def finish(self, result: Any) -> None:
        """What the call returned; ``program`` is set where it can be done again."""
        if any(id(tensor) not in self._known for tensor in tensors_of(result)):
            self.refuse("a result whose making was not seen")
        self._program.result = map_result(result, self._ref)
        self._known.clear()
        self.program = None if self.refused else self._program


def _idle_dropout(function: Any, args: Any, kwargs: dict[str, Any]) -> bool:
    """Whether it is ``F.dropout`` outside of training."""
    if function is not F.dropout:
        return False
    given = {**dict(zip(("input", "p", "training"), args, strict=False)), **kwargs}
    return not given.get("training", True) or given.get("p", 0.5) == 0
