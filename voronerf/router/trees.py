"""Nested values: arguments and results of any structure, their tensors, and the same structure with other tensors."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

_DEEPEST = 6  # objects within objects that are searched for tensors
_PLAIN = (int, float, str, bytes, type(None), torch.Size, torch.dtype, torch.device, slice, type, nn.Module)

Change = Callable[[str, Any, bool], Any]


def map_tree(
    value: Any, change: Change, name: str = "", *, batches: bool = False, nested: bool = False, depth: int = 0
) -> Any:
    """The same structure with every tensor changed: lists, tuples, named tuples, dicts, dataclasses, other objects.

    Args:
        value: Of any structure.
        change: Called with a tensor's name ("x", "samples.origins", "views.0"), the tensor, and whether it is inside an
            object; returns what goes in its place.
        name: Of the value.
        batches: Whether ``change`` also gets objects that have ``shape``, ``flatten()``, ``reshape(shape)`` and
            indexing of their own, as nerfstudio's ``TensorDataclass``, instead of their tensors.
        nested: Whether the value is inside an object.
        depth: Containers around the value; what lies deeper than six is left alone.

    Returns:
        The structure; where nothing in it changed, the same object.
    """
    if isinstance(value, Tensor) or (batches and is_batch(value)):
        return change(name, value, nested)
    return map_children(value, change, name, batches=batches, nested=nested, depth=depth)


def map_children(
    value: Any, change: Change, name: str = "", *, batches: bool = False, nested: bool = False, depth: int = 0
) -> Any:
    """:func:`map_tree` of what a container or an object holds, batch-like objects too."""
    items = None if depth > _DEEPEST else _items(value)
    if not items:
        return value
    nested = nested or not isinstance(value, (dict, list, tuple))
    new = {
        key: map_tree(item, change, f"{name}.{key}", batches=batches, nested=nested, depth=depth + 1)
        for key, item in items.items()
    }
    if all(new[key] is item for key, item in items.items()):
        return value
    return _rebuilt(value, items, new)


def _items(value: Any) -> dict[Any, Any] | None:
    """What a container holds, by key, index or attribute; None for what is no container."""
    if isinstance(value, _PLAIN):
        return None
    if isinstance(value, dict):
        return value
    if isinstance(value, (list, tuple)):
        return dict(enumerate(value))
    if callable(value):
        return None
    if hasattr(value, "__dict__"):
        return dict(vars(value))
    if dataclasses.is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return None


def _rebuilt(value: Any, items: dict[Any, Any], new: dict[Any, Any]) -> Any:
    if isinstance(value, (list, tuple)):
        parts = list(new.values())
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if type(value) is dict:
        return new
    changed = {key: item for key, item in new.items() if item is not items[key]}
    if isinstance(value, dict):
        try:
            rebuilt = copy.copy(value)
        except Exception:  # one that takes attributes for items, before Python 3.11
            rebuilt = type(value).__new__(type(value))
            rebuilt.update(value)
        rebuilt.update(changed)
        return rebuilt
    if hasattr(value, "__post_init__"):  # it may derive other attributes, such as a shape
        given = {f.name for f in dataclasses.fields(value) if f.init}
        value = dataclasses.replace(value, **{key: changed.pop(key) for key in given & changed.keys()})
    rebuilt = copy.copy(value)
    for key, item in changed.items():
        object.__setattr__(rebuilt, key, item)
    return rebuilt


def tensors_of(value: Any) -> list[Tensor]:
    """All tensors of a nested value, in the order of :func:`map_tree`."""
    found: list[Tensor] = []
    _collect(value, found, 0)
    return found


def _collect(value: Any, found: list[Tensor], depth: int) -> None:
    if isinstance(value, Tensor):
        found.append(value)
    elif depth <= _DEEPEST:
        # Every function of a grouped module comes here with its arguments: lists are not made dicts for it.
        for item in value if type(value) in (list, tuple) else (_items(value) or {}).values():
            _collect(item, found, depth + 1)


def rebuild(value: Any, tensors: Iterable[Any]) -> Any:
    """A nested value with other tensors in the order of :func:`tensors_of`."""
    following = iter(tensors)
    return map_tree(value, lambda name, tensor, nested: next(following))


def is_batch(value: Any) -> bool:
    """Whether an object has ``shape``, ``flatten()``, ``reshape(shape)`` and indexing of its own."""
    if isinstance(value, (Tensor, dict, list, tuple, *_PLAIN)) or not isinstance(
        getattr(value, "shape", None), (tuple, torch.Size)
    ):
        return False
    return all(callable(getattr(value, name, None)) for name in ("flatten", "reshape", "__getitem__"))
