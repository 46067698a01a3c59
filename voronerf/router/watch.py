"""The constants of a traced ``forward``: attributes and buffers of its module, and arguments that are not tensors.

A trace stores their values. Each call compares the stored values with the current ones, so that a schedule that sets
``module.progress`` takes effect. In buffers on a GPU or above 1 MiB, writes by ``buffer.data`` are not noticed.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from dataclasses import dataclass
from functools import partial
from numbers import Number
from types import FunctionType, MethodType, SimpleNamespace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from voronerf.ops._core.unchanged import Stale, Values, unchanged
from voronerf.router.grouping import owned_parameters, parts_of

Source = str | tuple[int, str]
"""An argument by its name, or an attribute by (index of its submodule in ``modules()``, name)."""

NUMBERS = (torch.float64, torch.float32, torch.int64)
"""The dtypes of inputs, tried in turn.

float64 does not round numbers; float32 promotes other dtypes in the same way as a Python number; int64 can be an index.
"""

HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_DICTIONARIES = frozenset({"_modules", *HOOKS})  # dictionaries of every module, of which only the contents change
_UNWATCHED = frozenset(vars(nn.Module())) - {"training", *_DICTIONARIES}
_OF_CLASSES = (bool, int, float, str, FunctionType)  # types of class attributes that a module's attribute may override
_MISSING: Any = object()
MOST = 64  # maximum number of watched containers in an attribute
_LIBRARIES = sys.stdlib_module_names | {"torch", "numpy"}
_CONTAINERS = (dict, list, tuple, set, frozenset)
_PLAIN = (*_CONTAINERS, SimpleNamespace, Namespace)


@dataclass(frozen=True)
class Inputs:
    """Attributes and arguments whose values are looked up in each fused call."""

    sources: frozenset[Source] = frozenset()
    dtype: torch.dtype = torch.float64  # dtype of numbers as tensors, one of NUMBERS
    others: tuple[tuple[Source, Any], ...] = ()  # old values of sources; the trace must hold for them too

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


class _Seen(NamedTuple):
    """A value that a trace took as a constant.

    Attributes:
        source: The place of the value in the module.
        registry: The dictionary that holds the current value under the source's name.
        value: The value.
        containers: The containers and the attributes of plain objects that the value is or holds, see `_containers`.
        items: The items of the containers.
        tensors: The values of the tensors among the value and its items.
    """

    source: tuple[int, str]
    registry: dict[str, Any]
    value: Any
    containers: tuple[Any, ...]
    items: tuple[Any, ...]
    tensors: list[Values]

    def changed(self) -> bool:
        """Returns whether the current value differs from the seen value."""
        items, value = _items(self.containers), self.registry.get(self.source[1], _MISSING)
        is_same = same(value, self.value) and len(items) == len(self.items) and all(map(same, items, self.items))
        return not is_same or any(tensor.changed() for tensor in self.tensors)

    def note(self, dependencies: Any) -> None:
        """Adds the value to ``dependencies`` (`voronerf.ops._core.unchanged`)."""
        if self.source[1] not in _DICTIONARIES:
            dependencies.entries(self.registry, [self.source[1]])
        for tensor in self.tensors:
            tensor.note(dependencies)
        for container in self.containers:
            dependencies.contents(container)


class Watch:
    """The values that a trace read from submodules, without parameters and inputs.

    Args:
        module: The traced module.
        reads: The attributes that were read, as (index of the submodule in ``modules()``, name).
        inputs: The values that each call looks up.
    """

    def __init__(self, module: nn.Module, reads: set[tuple[int, str]], inputs: Inputs) -> None:
        parts, self._seen, self._dependencies = list(parts_of(module).values()), list[_Seen](), cast(Any, Stale())
        for place, name in sorted(reads):
            part = parts[place]
            if (place, name) in inputs.sources or name in part._parameters or name in _UNWATCHED:
                continue
            registries = vars(part), part._buffers, part._modules
            registry = next((entries for entries in registries if name in entries), vars(part))
            value = registry.get(name, _MISSING)
            if value is _MISSING and not isinstance(getattr(type(part), name, None), _OF_CLASSES):
                continue  # a property, or no attribute
            items = _items(containers := _containers(value))
            tensors = [Values(item) for item in (value, *items) if isinstance(item, Tensor)]
            self._seen.append(_Seen((place, name), registry, value, containers, items, tensors))

    def value(self, source: Source) -> Any:
        """Returns the value that the trace read from a source; None if it did not read the source."""
        return next((seen.value for seen in self._seen if seen.source == source), None)

    def note(self, dependencies: Any) -> Any:
        """Adds the watched values to ``dependencies``, and returns it."""
        for seen in self._seen:
            seen.note(dependencies)
        return dependencies

    def changed(self) -> list[Source]:
        """Lists the sources whose values have changed."""
        if self._dependencies.holds():
            return []
        changed: list[Source] = [seen.source for seen in self._seen if seen.changed()]
        if not changed:  # values in new objects are equal
            self._dependencies = self.note(unchanged())
        return changed


def module_dependencies(module: nn.Module) -> Any:
    """Returns dependencies on a module's submodules and on the types of its parameters."""
    dependencies = unchanged()
    for part, name, _ in owned_parameters(module):
        dependencies.kind(part._parameters, name)
    for part in parts_of(module).values():
        if part._modules:
            dependencies.contents(part._modules)
    return dependencies


def _containers(value: Any) -> tuple[Any, ...]:
    """Returns the containers and the attributes of plain objects that a value is or holds, at most `MOST`.

    Plain objects may be callable, such as an encoder; a bound method is its object, and a partial function its
    function and arguments. Objects of libraries, such as a logger, are not looked into.
    """
    pending, found = [value], dict[int, Any]()
    while pending and len(found) < MOST:
        item = pending.pop(0)
        if isinstance(item, partial):
            pending += [item.func, item.args, item.keywords]
        item = item.__self__ if isinstance(item, MethodType) else item
        of_library = type(item).__module__.partition(".")[0] in _LIBRARIES and not isinstance(item, _PLAIN)
        opaque = isinstance(item, (Tensor, nn.Module, type)) or (of_library and callable(item))
        container = item if isinstance(item, _CONTAINERS) else None if opaque else getattr(item, "__dict__", None)
        if container is not None and id(container) not in found:
            found[id(container)] = container
            pending += () if of_library else _items((container,))
    return tuple(found.values())


def _items(containers: tuple[Any, ...]) -> tuple[Any, ...]:
    """Returns the items of containers, and the keys of dictionaries."""
    return tuple(item for each in containers for item in (*each, *(each.values() if isinstance(each, dict) else ())))


def same(a: Any, b: Any) -> bool:
    """Returns whether two values are the same object, or equal numbers or texts."""
    return a is b or (type(a) is type(b) and isinstance(a, (Number, str, torch.dtype, torch.device)) and bool(a == b))
