"""The constants of a traced ``forward``: attributes and buffers of its module, and arguments that are not tensors.

A trace stores their values. Each call compares the stored values with the current ones, so that a schedule that sets
``module.progress`` takes effect. In buffers on a GPU or above 1 MiB, writes by ``buffer.data`` are not noticed.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Number
from types import FunctionType
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
        container: The value if it is a container, or the attributes of a plain object; None for other values.
        items: The items of the container.
        tensors: The values of the tensors among the value and its items.
    """

    source: tuple[int, str]
    registry: dict[str, Any]
    value: Any
    container: Any
    items: tuple[Any, ...]
    tensors: list[Values]

    def changed(self) -> bool:
        """Returns whether the current value differs from the seen value."""
        items, value = _items(self.container), self.registry.get(self.source[1], _MISSING)
        is_same = same(value, self.value) and len(items) == len(self.items) and all(map(same, items, self.items))
        return not is_same or any(tensor.changed() for tensor in self.tensors)

    def note(self, dependencies: Any) -> None:
        """Adds the value to ``dependencies`` (`voronerf.ops._core.unchanged`)."""
        if self.source[1] not in _DICTIONARIES:
            dependencies.entries(self.registry, [self.source[1]])
        for tensor in self.tensors:
            tensor.note(dependencies)
        if self.container is not None:
            dependencies.contents(self.container)


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
            items = _items(container := _container(value))
            tensors = [Values(item) for item in (value, *items) if isinstance(item, Tensor)]
            self._seen.append(_Seen((place, name), registry, value, container, items, tensors))

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


def _container(value: Any) -> Any:
    """Returns a container itself, the attributes of a plain object, or None for other values."""
    if isinstance(value, (dict, list, tuple, set, frozenset)):
        return value
    other = isinstance(value, (Tensor, nn.Module, type)) or callable(value) or not hasattr(value, "__dict__")
    return None if other else vars(value)


def _items(container: Any) -> tuple[Any, ...]:
    """Returns the items of a container, one level deep."""
    return (*container, *container.values()) if isinstance(container, dict) else tuple(container or ())


def same(a: Any, b: Any) -> bool:
    """Returns whether two values are the same object, or equal numbers or texts."""
    return a is b or (type(a) is type(b) and isinstance(a, (Number, str, torch.dtype, torch.device)) and bool(a == b))
