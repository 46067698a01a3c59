"""A double of a routed module: a copy that runs instead of the module, with other tensors as parameters.

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
_LAYERS = "torch.nn.modules."  # modules from this package assign no attributes in ``forward``
_REGISTRIES, _OF_HOOKS = ("_parameters", "_buffers", "_modules"), (OrderedDict, dict, set)
_SEARCHED = 1000  # maximum number of objects in an attribute that are searched for submodules


class Forbidden(TypeError):
    """An error for a method that changes the parameters of its module."""


class Double:
    """A copy of a module tree that shares its buffers and has its own registries of parameters.

    Each run starts with the module's attributes; attributes assigned by ``forward`` are dropped after the run.

    Args:
        module: The routed module, or a field.
        reads: A set to which each run adds (index of the submodule in ``modules()``, name) for every attribute that it
            reads; None to record nothing.
    """

    def __init__(self, module: nn.Module, reads: set[tuple[int, str]] | None = None) -> None:
        parts = parts_of(module)
        twins = {key: _twin(part, place, reads) for place, (key, part) in enumerate(parts.items())}
        for key, part in parts.items():  # a compiled submodule is replaced by its original
            twins[key] = twins.get(id(getattr(part, "_orig_mod", None)), twins[key])
        self.module, self.parts = twins[id(module)], list(twins.values())  # in the order of ``modules()``
        self._places: list[tuple[dict[str, Any], str, int]] = []
        self._assignable: list[tuple[nn.Module, dict[str, Any]]] = []  # submodules that may assign attributes
        self._registries: list[tuple[nn.Module, dict[str, Any], set[str]]] = []
        for key, part in parts.items():
            twin, members = twins[key], dict(vars(part))
            if twin is part:
                continue
            registry = members["_parameters"] = dict(part._parameters)
            members["_buffers"] = dict(part._buffers)
            members["_modules"] = {name: twins.get(id(child), child) for name, child in part._modules.items()}
            rest = [item for item in members.items() if type(item[1]) not in _PLAIN]
            for name, value in rest:  # nearly all are empty dicts of hooks
                if (type(value) not in _OF_HOOKS or value) and name not in _REGISTRIES and _reaches(value, parts):
                    members[name] = _moved(value, twins)
            vars(twin).update(members)
            if not type(part).__module__.startswith(_LAYERS) or part._forward_pre_hooks:
                self._assignable.append((twin, members))
            self._places += [(registry, name, id(p)) for name, p in registry.items() if p is not None]
            self._registries.append((twin, registry, set(registry)))

    def run(self, call: Call, rows: Iterable[Tensor], values: Mapping[int, Any], mode: Any = None) -> Any:
        """Runs a call with ``rows`` as its arguments, and with ``values``, by parameter id, as its parameters.

        The PyTorch function mode ``mode``, if any, is active only while the method runs.

        Raises:
            Forbidden: If the method adds, removes or replaces parameters, or writes into them.
        """
        placed = self.fill(values)
        versions = _versions(placed)
        copied = Call(self.module, call.method, call.layout, call.names, call.args, call.kwargs, call.kinds)
        try:
            with mode or contextlib.nullcontext():
                return copied.run(rows)
        finally:
            self._check(call.name, placed, versions)
            self._restore_attributes()

    def _check(self, name: str, placed: list[tuple[dict[str, Any], str, Any]], versions: list[int]) -> None:
        """Raises Forbidden if a run has changed the parameters."""
        for twin, registry, names in self._registries:
            if vars(twin)["_parameters"] is not registry or registry.keys() != names:
                odd = sorted(vars(twin)["_parameters"].keys() ^ names)
                raise Forbidden(f"{_OP}: {name} must not add or remove parameters, but does so with {odd[0]!r}")
        now = _versions(placed)
        for (registry, key, value), before, after in zip(placed, versions, now, strict=True):
            if registry[key] is not value or before != after:
                action = "replace parameters" if registry[key] is not value else "write into its parameters"
                raise Forbidden(f"{_OP}: {name} must not {action}, but does so with {key!r}")

    def _restore_attributes(self) -> None:
        """Gives the submodules the attributes that they had before the run."""
        for twin, members in self._assignable:
            attributes = vars(twin)
            if attributes.keys() != members.keys() or not all(map(operator.is_, attributes.values(), members.values())):
                attributes.clear()
                attributes.update(members)

    def fill(self, values: Mapping[int, Any]) -> list[tuple[dict[str, Any], str, Any]]:
        """Replaces each parameter whose id is in ``values``; lists (registry, name, tensor) of the replacements."""
        placed = [(registry, name, values[key]) for registry, name, key in self._places if key in values]
        for registry, name, value in placed:
            registry[name] = value
        return placed

    def own_buffers(self) -> None:
        """Copies the buffers, so that the double no longer shares them."""
        for part in self.module.modules():
            part._buffers = {name: None if b is None else b.clone() for name, b in part._buffers.items()}

    def end(self) -> None:
        """Removes the parameters, so that the module's code fails if the backward pass runs it again."""
        for registry, _, _ in self._places:
            registry.clear()


def _twin(part: nn.Module, place: int, reads: set[tuple[int, str]] | None) -> nn.Module:
    """Returns an empty object of a submodule's class, or the submodule itself if it holds nothing that changes."""
    empty = not (part._parameters or part._modules or part._buffers)
    plain = empty and type(part).__module__.startswith(_LAYERS) and reads is None
    if plain or isinstance(part, torch.jit.ScriptModule):
        return part
    twin: nn.Module = object.__new__(type(part) if reads is None else _recording_class(type(part), place, reads))
    return twin


class _Unregistered:
    """A base class whose ``__init_subclass__`` does nothing.

    Many classes register their subclasses in ``__init_subclass__``. The subclasses that `_recording_class` makes must
    not appear in such a registry.
    """

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        pass


def _recording_class(kind: type[nn.Module], place: int, reads: set[tuple[int, str]]) -> type[nn.Module]:
    """Makes a subclass that adds (``place``, name) of each accessed attribute to ``reads``."""

    def getattribute(self: nn.Module, name: str) -> Any:
        reads.add((place, name))
        return kind.__getattribute__(self, name)

    names = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "__getattribute__": getattribute}
    metaclass: Any = type(kind)
    recording: type[nn.Module] = metaclass(kind.__name__, (_Unregistered, kind), names)
    return recording


def _versions(placed: list[tuple[dict[str, Any], str, Any]]) -> list[int]:
    """Lists the version counters of tensors; this must be fast, since a loop over cells does it hundreds of times."""
    try:
        return [value._version for _, _, value in placed]
    except RuntimeError:  # inference-mode tensors have no version counter
        return [0] * len(placed)


def _reaches(value: Any, parts: Mapping[int, nn.Module]) -> bool:
    """Returns whether a value holds a submodule of the module."""
    pending, seen = [value], set[int]()
    while pending and len(seen) < _SEARCHED:
        item = pending.pop()
        if type(item) in _PLAIN or id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, nn.Module):
            if id(item) in parts:
                return True
        elif isinstance(item, types.MethodType):
            pending.append(item.__self__)
        elif isinstance(item, functools.partial):
            pending += [item.func, *item.args, *item.keywords.values()]
        elif isinstance(item, dict):
            pending += item.values()
        elif isinstance(item, (list, tuple, set, frozenset)):
            pending += item
        elif not isinstance(item, (Tensor, type, types.ModuleType)):
            pending += getattr(item, "__dict__", {}).values()
    return False


def _moved(value: Any, twins: Mapping[int, nn.Module]) -> Any:
    """Returns the value with its submodules replaced by their twins."""

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
