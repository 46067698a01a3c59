"""The constants of a traced ``forward``: attributes and buffers of its module, and arguments that are no tensors.

A trace holds their values. Each call compares them with what they are then, so that a schedule that sets
``module.progress`` is followed and not ignored.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from numbers import Number
from types import FunctionType
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.grouping import parts_of

Source = str | tuple[int, str]
"""An argument by its name, or an attribute by the place of its part in ``modules()`` and its name."""

NUMBERS = (torch.float64, torch.float32, torch.int64)
"""Dtypes of inputs: a number rounds nothing, decides no dtype beside integers, and may be an index."""

_OWN = frozenset(vars(nn.Module())) - {"training"}
HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_MISSING: Any = object()


@dataclass(frozen=True)
class Inputs:
    """Attributes that a trace reads anew at each call."""

    sources: frozenset[Source] = frozenset()
    dtype: torch.dtype = torch.float64  # of numbers, one of NUMBERS

    def tensor(self, value: Any, device: torch.device) -> Tensor:
        """A number as a tensor, and a tensor as it is."""
        return value if isinstance(value, Tensor) else torch.tensor(value, dtype=self.dtype, device=device)


def is_number(value: Any) -> bool:
    """Whether a value can be an input of a trace."""
    return isinstance(value, (Tensor, Number)) and not isinstance(value, (bool, complex))


def lookup(part: nn.Module, name: str) -> Any:
    """An attribute or a buffer of a part of a module, without properties and the class."""
    members = vars(part)
    return members[name] if name in members else part._buffers.get(name, _MISSING)


@dataclass
class Watch:
    """Values that a trace took as fixed, and where they are now."""

    sources: list[Source] = field(default_factory=list)
    _values: list[Any] = field(default_factory=list)
    _dicts: list[tuple[dict[str, Any], str]] = field(default_factory=list)
    _tensors: list[Tensor] = field(default_factory=list)
    _versions: list[int] = field(default_factory=list)
    _of_tensors: list[Source] = field(default_factory=list)
    _holders: list[tuple[Source, Any, tuple[Any, ...]]] = field(default_factory=list)
    _hooks: list[dict[int, Any]] = field(default_factory=list)
    _counts: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, module: nn.Module, reads: set[tuple[int, str]], inputs: Inputs) -> Watch:
        """Of what was read of the parts of a module, but for what is an input."""
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
            elif name not in _OWN:
                watch._add(source, part)
        return watch

    def _add(self, source: tuple[int, str], part: nn.Module) -> None:
        name = source[1]
        registry = next((entries for entries in (vars(part), part._buffers, part._modules) if name in entries), None)
        if registry is None:
            if not isinstance(getattr(type(part), name, None), (bool, int, float, str, FunctionType)):
                return  # a property or none
            registry = vars(part)  # of which a value would come before that of the class
        value = registry.get(name, _MISSING)
        self.sources.append(source)
        self._values.append(value)
        self._dicts.append((registry, name))
        if isinstance(value, Tensor):
            if not value.is_inference():  # whose changes nobody counts
                self._tensors.append(value)
                self._versions.append(value._version)
                self._of_tensors.append(source)
        elif value is not _MISSING and (held := _held(value)) is not None:
            self._holders.append((source, value, held))

    def note(self, guard: Any) -> None:
        """Has a guard of `unchanged` look at the same."""
        for registry, name in self._dicts:
            guard.entries(registry, [name])
        for tensor in self._tensors:
            guard.attributes(tensor, ["_version"])
        for _, value, _ in self._holders:
            guard.contents(value if isinstance(value, (dict, list, tuple, set, frozenset)) else vars(value))
        for hooks in self._hooks:
            guard.contents(hooks)

    def changed(self) -> list[Source]:
        """The sources whose values have changed."""
        changed = list[Source]()
        now = [registry.get(name, _MISSING) for registry, name in self._dicts]
        if not all(map(operator.is_, now, self._values)):
            changed += [s for s, a, b in zip(self.sources, now, self._values, strict=True) if not same(a, b)]
        if self._tensors and [tensor._version for tensor in self._tensors] != self._versions:
            pairs = zip(self._of_tensors, self._tensors, self._versions, strict=True)
            changed += [source for source, tensor, version in pairs if tensor._version != version]
        for source, value, held in self._holders:
            items = _held(value) or ()
            if len(items) == len(held) and all(map(operator.is_, items, held)):
                continue
            if len(items) != len(held) or not all(map(same, items, held)):
                changed.append(source)
        if [*map(len, self._hooks)] != self._counts:
            changed.append((0, "hooks"))
        return changed


def _held(value: Any) -> tuple[Any, ...] | None:
    """What a container or a plain object holds, one level deep."""
    if isinstance(value, dict):
        return (*value, *value.values())
    if isinstance(value, (list, tuple, set, frozenset)):
        return tuple(value)
    if isinstance(value, (nn.Module, type)) or callable(value) or not hasattr(value, "__dict__"):
        return None
    return tuple(vars(value).values())


def same(a: Any, b: Any) -> bool:
    """Whether two values are the same object, or equal numbers or texts."""
    return a is b or (type(a) is type(b) and isinstance(a, (Number, str, torch.dtype, torch.device)) and bool(a == b))
