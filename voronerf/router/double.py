"""A double of a routed module, which runs in its place with other tensors where its parameters are.

The module itself never changes, so other threads may save, copy or call it at any time.
"""

from __future__ import annotations

import contextlib
import functools
import operator
import types
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.grouping import parts_of
from voronerf.router.layout import Call, map_tree

_OP = "VoronoiRouter"
_PLAIN = {type(None), bool, int, float, str, type, torch.dtype, torch.device, torch.Size, types.FunctionType, Tensor}
_LAYERS = "torch.nn.modules."  # whose classes assign nothing in ``forward``
_REGISTRIES, _OF_HOOKS = ("_parameters", "_buffers", "_modules"), (OrderedDict, dict, set)
_SEARCHED = 1000  # objects of an attribute that are searched for parts of the module


class Forbidden(TypeError):
    """A method changes the parameters of its module."""


class Double:
    """Copies of the parts of a module, which share its buffers and have registries of their own.

    Each run begins with the attributes that the module has, so what ``forward`` assigns is of that run alone.

    Args:
        module: The routed module, or a field.
        reads: Collects (place, name) of the attributes that are read of the copies; None where nobody asks.
    """

    def __init__(self, module: nn.Module, reads: set[tuple[int, str]] | None = None) -> None:
        parts = parts_of(module)
        twins = {key: _twin(part, place, reads) for place, (key, part) in enumerate(parts.items())}
        for key, part in parts.items():  # a compiled part runs as it was before
            twins[key] = twins.get(id(getattr(part, "_orig_mod", None)), twins[key])
        self.module, self.parts = twins[id(module)], list(twins.values())  # in the order of ``modules()``
        self._places: list[tuple[dict[str, Any], str, int]] = []
        self._kept: list[tuple[nn.Module, dict[str, Any]]] = []  # parts whose ``forward`` may assign, and what they had
        self._registries: list[tuple[nn.Module, dict[str, Any], set[str]]] = []
        for key, part in parts.items():
            twin, members = twins[key], dict(vars(part))
            if twin is part:
                continue
            registry = members["_parameters"] = dict(part._parameters)
            members["_buffers"] = dict(part._buffers)
            members["_modules"] = {name: twins.get(id(child), child) for name, child in part._modules.items()}
            others = [item for item in members.items() if type(item[1]) not in _PLAIN]
            for name, value in others:  # nearly all of them are empty dicts of hooks
                if (type(value) not in _OF_HOOKS or value) and name not in _REGISTRIES and _reaches(value, parts):
                    members[name] = _moved(value, twins)
            vars(twin).update(members)
            if not type(part).__module__.startswith(_LAYERS) or part._forward_pre_hooks:
                self._kept.append((twin, members))
            self._places += [(registry, name, id(p)) for name, p in registry.items() if p is not None]
            self._registries.append((twin, registry, set(registry)))

    def run(self, call: Call, rows: Iterable[Tensor], values: Mapping[int, Any], mode: Any = None) -> Any:
        """A call with the rows of its arguments, and tensors by the id of the parameter in whose place they are.

        The ``mode`` sees the functions of the method alone.

        Raises:
            Forbidden: Where the method adds, removes or replaces parameters, or writes into them.
        """
        placed = self.fill(values)
        versions = _versions(placed)
        copied = Call(self.module, call.method, call.layout, call.names, call.args, call.kwargs, call.kinds)
        try:
            with mode or contextlib.nullcontext():
                return copied.run(rows)
        finally:
            self._check(call.name, placed, versions)
            self._begin_again()

    def _check(self, name: str, placed: list[tuple[dict[str, Any], str, Any]], versions: list[int]) -> None:
        """Raises Forbidden where a run has changed the parameters."""
        for twin, registry, names in self._registries:
            if vars(twin)["_parameters"] is not registry or registry.keys() != names:
                odd = sorted(vars(twin)["_parameters"].keys() ^ names)
                raise Forbidden(f"{_OP}: {name} must not add or remove parameters, but does so with {odd[0]!r}")
        now = _versions(placed)
        for (registry, key, value), before, after in zip(placed, versions, now, strict=True):
            if registry[key] is not value or before != after:
                does = "replace parameters" if registry[key] is not value else "write into its parameters"
                raise Forbidden(f"{_OP}: {name} must not {does}, but does so with {key!r}")

    def _begin_again(self) -> None:
        """Gives the parts the attributes that they had before the run."""
        for twin, members in self._kept:
            now = vars(twin)
            if now.keys() != members.keys() or not all(map(operator.is_, now.values(), members.values())):
                now.clear()
                now.update(members)

    def fill(self, values: Mapping[int, Any]) -> list[tuple[dict[str, Any], str, Any]]:
        """Puts tensors in the place of parameters, by their id; gives (registry, name, tensor) of each."""
        placed = [(registry, name, values[key]) for registry, name, key in self._places if key in values]
        for registry, name, value in placed:
            registry[name] = value
        return placed

    def own_buffers(self) -> None:
        """Gives the double buffers of its own."""
        for part in self.module.modules():
            part._buffers = {name: None if b is None else b.clone() for name, b in part._buffers.items()}

    def end(self) -> None:
        """Takes the parameters away, so that code that runs again in the backward pass fails."""
        for registry, _, _ in self._places:
            registry.clear()


def _twin(part: nn.Module, place: int, reads: set[tuple[int, str]] | None) -> nn.Module:
    """An empty object for a part, or the part itself if it holds nothing that changes."""
    empty = not (part._parameters or part._modules or part._buffers)
    plain = empty and type(part).__module__.startswith(_LAYERS) and reads is None
    if plain or isinstance(part, torch.jit.ScriptModule):
        return part
    twin: nn.Module = object.__new__(type(part) if reads is None else _noting(type(part), place, reads))
    return twin


class _Unregistered:
    """Keeps a class with a registry of its subclasses from adding those of :func:`_noting`."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        pass


def _noting(kind: type[nn.Module], place: int, reads: set[tuple[int, str]]) -> type[nn.Module]:
    """A subclass that collects (place, name) of the attributes that are read of its object."""

    def noted(self: nn.Module, name: str) -> Any:
        reads.add((place, name))
        return kind.__getattribute__(self, name)

    names = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "__getattribute__": noted}
    metaclass: Any = type(kind)
    made: type[nn.Module] = metaclass(kind.__name__, (_Unregistered, kind), names)
    return made


def _versions(placed: list[tuple[dict[str, Any], str, Any]]) -> list[int]:
    """The version counter of each tensor; a loop over cells reads it some hundred times a call."""
    try:
        return [value._version for _, _, value in placed]
    except RuntimeError:  # of those of inference mode nobody knows
        return [0] * len(placed)


def _reaches(value: Any, parts: Mapping[int, nn.Module]) -> bool:
    """Whether a value holds a part of the module."""
    left, seen = [value], set[int]()
    while left and len(seen) < _SEARCHED:
        item = left.pop()
        if type(item) in _PLAIN or id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, nn.Module):
            if id(item) in parts:
                return True
        elif isinstance(item, types.MethodType):
            left.append(item.__self__)
        elif isinstance(item, functools.partial):
            left += [item.func, *item.args, *item.keywords.values()]
        elif isinstance(item, dict):
            left += item.values()
        elif isinstance(item, (list, tuple, set, frozenset)):
            left += item
        elif not isinstance(item, (Tensor, type, types.ModuleType)):
            left += getattr(item, "__dict__", {}).values()
    return False


def _moved(value: Any, twins: Mapping[int, nn.Module]) -> Any:
    """The same with twins in the place of parts."""

    def change(name: str, leaf: Any, nested: bool) -> Any:
        if isinstance(leaf, nn.Module):
            return twins.get(id(leaf), leaf)
        if isinstance(leaf, types.MethodType):
            return types.MethodType(leaf.__func__, _moved(leaf.__self__, twins))
        if isinstance(leaf, functools.partial):
            return functools.partial(
                _moved(leaf.func, twins), *_moved(leaf.args, twins), **_moved(leaf.keywords, twins)
            )
        if isinstance(leaf, (set, frozenset)):
            return type(leaf)(_moved(item, twins) for item in leaf)
        if callable(leaf) and type(leaf) not in _PLAIN and not isinstance(leaf, type) and hasattr(leaf, "__dict__"):
            moved: Any = object.__new__(type(leaf))
            vars(moved).update({name: _moved(item, twins) for name, item in vars(leaf).items()})
            return moved
        return leaf

    return map_tree(value, change)
