"""The constants of a traced ``forward``: attributes and buffers of its module, and arguments that are not tensors.

A trace stores their values. Each call compares the stored values with the current ones, so that a schedule that sets
``module.progress`` takes effect. In buffers on a GPU or above 1 MiB, writes by ``buffer.data`` are not noticed.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from numbers import Number
from types import FunctionType
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.ops._core.unchanged import Values
from voronerf.router.grouping import parts_of

Source = str | tuple[int, str]
"""An argument by its name, or an attribute by (index of its submodule in ``modules()``, name)."""

NUMBERS = (torch.float64, torch.float32, torch.int64)
"""The dtypes of inputs, tried in turn.

float64 does not round numbers; float32 promotes other dtypes in the same way as a Python number; int64 can be an index.
"""

_MODULE_ATTRIBUTES = frozenset(vars(nn.Module())) - {"training"}
HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_MISSING: Any = object()


@dataclass(frozen=True)
class Inputs:
    """Attributes and arguments whose values are looked up in each fused call."""

    sources: frozenset[Source] = frozenset()
    dtype: torch.dtype = torch.float64  # dtype of numbers as tensors, one of NUMBERS
    others: tuple[tuple[Source, Any], ...] = ()  # earlier values of sources, for which the trace must hold, too

    def tensor(self, value: Any, device: torch.device) -> Tensor:
        """Returns a number as a tensor, and a tensor unchanged."""
        return value if isinstance(value, Tensor) else torch.tensor(value, dtype=self.dtype, device=device)


def is_number(value: Any) -> bool:
    """Returns whether a value can be an input of a trace."""
    return isinstance(value, (Tensor, Number)) and not isinstance(value, (bool, complex))


def lookup(part: nn.Module, name: str) -> Any:
    """Returns an attribute or a buffer of a submodule itself, not of its class."""
    members = vars(part)
    return members[name] if name in members else part._buffers.get(name, _MISSING)


@dataclass
class Watch:
    """Values that a trace took as constants, and the places of their current values."""

    sources: list[Source] = field(default_factory=list)
    _values: list[Any] = field(default_factory=list)
    _dicts: list[tuple[dict[str, Any], str]] = field(default_factory=list)
    _tensors: list[tuple[Source, Values]] = field(default_factory=list)
    _holders: list[tuple[Source, Any, tuple[Any, ...]]] = field(default_factory=list)
    _hooks: list[dict[int, Any]] = field(default_factory=list)
    _counts: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, module: nn.Module, reads: set[tuple[int, str]], inputs: Inputs) -> Watch:
        """Makes a watch of the values read from submodules, excluding inputs."""
        watch, parts = cls(), list(parts_of(module).values())
        for place, name in sorted(reads):
            part, source = parts[place], (place, name)
            if source in inputs.sources or name in part._parameters:
                continue
            if name in HOOKS:
                watch._hooks.append(vars(part)[name])
                watch._counts.append(len(vars(part)[name]))
            elif name == "_modules":
                watch._holders.append((source, part._modules, (*part._modules, *part._modules.values())))
            elif name not in _MODULE_ATTRIBUTES:
                watch._add(source, part)
        return watch

    def _add(self, source: tuple[int, str], part: nn.Module) -> None:
        name = source[1]
        registry = next((entries for entries in (vars(part), part._buffers, part._modules) if name in entries), None)
        if registry is None:
            if not isinstance(getattr(type(part), name, None), (bool, int, float, str, FunctionType)):
                return  # a property, or no attribute
            registry = vars(part)  # a value set here would override the class attribute
        value = registry.get(name, _MISSING)
        self.sources.append(source)
        self._values.append(value)
        self._dicts.append((registry, name))
        items = None if value is _MISSING or isinstance(value, Tensor) else _items(value)
        if items is not None:
            self._holders.append((source, value, items))
        for item in (value,) if items is None else items:
            if isinstance(item, Tensor):
                self._tensors.append((source, Values(item)))

    def value(self, source: Source) -> Any:
        """Returns the value that a trace took as a constant; None if there is none."""
        return dict(zip(self.sources, self._values, strict=True)).get(source)

    def note(self, guard: Any) -> None:
        """Adds the watched values to a guard, which detects their changes (`voronerf.ops._core.unchanged`)."""
        for registry, name in self._dicts:
            guard.entries(registry, [name])
        for _, tensor in self._tensors:
            tensor.note(guard)
        for _, value, _ in self._holders:
            guard.contents(value if isinstance(value, (dict, list, tuple, set, frozenset)) else vars(value))
        for hooks in self._hooks:
            guard.contents(hooks)

    def changed(self) -> list[Source]:
        """Lists the sources whose values have changed."""
        changed = list[Source]()
        values = [registry.get(name, _MISSING) for registry, name in self._dicts]
        if not all(map(operator.is_, values, self._values)):
            changed += [s for s, a, b in zip(self.sources, values, self._values, strict=True) if not same(a, b)]
        changed += [source for source, tensor in self._tensors if tensor.changed()]
        for source, value, old_items in self._holders:
            items = _items(value) or ()
            if len(items) == len(old_items) and all(map(operator.is_, items, old_items)):
                continue
            if len(items) != len(old_items) or not all(map(same, items, old_items)):
                changed.append(source)
        if [*map(len, self._hooks)] != self._counts:
            changed.append((0, "hooks"))
        return changed


def _items(value: Any) -> tuple[Any, ...] | None:
    """Returns the items of a container or a plain object, one level deep; None for other values."""
    if isinstance(value, dict):
        return (*value, *value.values())
    if isinstance(value, (list, tuple, set, frozenset)):
        return tuple(value)
    if isinstance(value, (nn.Module, type)) or callable(value) or not hasattr(value, "__dict__"):
        return None
    return tuple(vars(value).values())


def same(a: Any, b: Any) -> bool:
    """Returns whether two values are the same object, or equal numbers or texts."""
    return a is b or (type(a) is type(b) and isinstance(a, (Number, str, torch.dtype, torch.device)) and bool(a == b))
