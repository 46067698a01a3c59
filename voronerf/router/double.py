"""A double of a routed module: a copy that runs instead of the module, with other tensors as parameters.

The module itself never changes, so other threads may save, copy or call it at any time.
"""

from __future__ import annotations

import contextlib
import functools
import math
import operator
import sys
import types
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.grouping import CHANGES, HOLDERS, SHARED, parts_of
from voronerf.router.layout import Call, map_tree, reachable

_OP = "VoronoiRouter"
_PLAIN = {type(None), bool, int, float, str, type, torch.dtype, torch.device, torch.Size, types.FunctionType, Tensor}
_LAYERS = "torch.nn.modules."  # its modules, except RNNs, assign no attributes in ``forward``
_REGISTRIES, _OF_HOOKS = ("_parameters", "_buffers", "_modules"), (OrderedDict, dict, set)
_SEARCHED = 1000  # maximum number of searched objects in an attribute that is not one of HOLDERS


class Forbidden(TypeError):
    """An error for a method that changes the parameters of its module, or whose results show that it mixes samples."""


class Double:
    """A copy of a module tree that shares its buffers and has its own registries of parameters.

    Each run starts with the module's attributes; attributes that ``forward`` assigns are dropped after the run, and the
    items of :data:`CHANGES` are restored. Parameters and submodules in other attributes are replaced, too.

    Args:
        module: The routed module, or a field.
        reads: A set to which each run adds (index of the submodule in ``modules()``, name) for every attribute that it
            reads; None to record nothing.

    Attributes:
        stacked: The stacked parameters of the module, without those that cells share, by id.
        assigned: Numbers that runs assigned to attributes and dropped, by (index of the submodule, name).
        writes: With ``reads``, the file and line of the first assignment to each attribute that was read before.
    """

    def __init__(self, module: nn.Module, reads: set[tuple[int, str]] | None = None) -> None:
        parts, self.writes = parts_of(module), dict[tuple[int, str], tuple[str, int]]()
        twins = {key: _twin(part, place, reads, self.writes) for place, (key, part) in enumerate(parts.items())}
        for key, part in parts.items():  # a compiled submodule is replaced by its original
            twins[key] = twins.get(id(getattr(part, "_orig_mod", None)), twins[key])
        self.module, self.parts = twins[id(module)], list(twins.values())  # in the order of ``modules()``
        self._places: list[tuple[dict[str, Any], str, int]] = []
        self._assignable: list[tuple[int, nn.Module, dict[str, Any]]] = []  # submodules that may assign attributes
        self._registries: list[tuple[nn.Module, dict[str, Any], set[str]]] = []
        self._containers: list[Any] = []  # lists, dicts and sets whose items are restored after each run
        self._held: list[tuple[dict[str, Any], dict[str, Any], str, Any]] = []  # attributes that hold parameters
        self.assigned: dict[tuple[int, str], Any] = {}
        self.stacked: dict[int, nn.Parameter] = {}
        parameters = {id(p) for part in parts.values() for p in part._parameters.values()}
        for place, (key, part) in enumerate(parts.items()):
            twin, members = twins[key], dict(vars(part))
            if twin is part:
                continue
            registry = members["_parameters"] = dict(part._parameters)
            members["_buffers"] = dict(part._buffers)
            members["_modules"] = {name: twins.get(id(child), child) for name, child in part._modules.items()}
            holders = members.get(HOLDERS, ())
            for name, value in list(members.items()):
                kind = type(value)
                if kind in _PLAIN or (kind in _OF_HOOKS and not value) or name in _REGISTRIES:
                    continue  # nearly all are empty dicts of hooks
                held = {*map(id, reachable(value, math.inf if name in holders else _SEARCHED))}
                if not held.isdisjoint(parts):
                    members[name] = moved(value, twins)
                if not held.isdisjoint(parameters):
                    self._held.append((vars(twin), members, name, members[name]))
            self._containers += [members[name] for name in members.get(CHANGES, ()) if name in members]
            if part._buffers:  # a buffer that ``forward`` assigns must not reach the next cell
                self._containers.append(members["_buffers"])
            if isinstance(part, nn.RNNBase):  # flatten_parameters would move the cells' weights
                members["flatten_parameters"] = _nothing
            vars(twin).update(members)
            if not type(part).__module__.startswith(_LAYERS) or part._forward_pre_hooks or isinstance(part, nn.RNNBase):
                self._assignable.append((place, twin, members))
            shared = members.get(SHARED, ())
            for name, parameter in registry.items():
                if parameter is not None:
                    self._places.append((registry, name, id(parameter)))
                    if name not in shared:
                        self.stacked[id(parameter)] = parameter
            self._registries.append((twin, registry, set(registry)))

    def run(self, call: Call, rows: Iterable[Tensor], values: Mapping[int, Any] | None = None, mode: Any = None) -> Any:
        """Runs a call once; see :meth:`runs`. Without ``values``, the parameters are constants: the first cell's."""
        values = {key: p.detach()[0] for key, p in self.stacked.items()} if values is None else values
        return self.runs(call, [rows], [values], mode)[0]

    def runs(
        self, call: Call, parts: Iterable[Iterable[Tensor]], values: Iterable[Mapping[int, Any]], mode: Any = None
    ) -> list[Any]:
        """Runs a call for each part of the rows, each with one item of ``values`` as the parameters, by id.

        All values of a parameter must be slices of one tensor, so that they share its version counter. The PyTorch
        function mode ``mode``, if any, is active only while the method runs.

        Raises:
            Forbidden: If the method adds, removes or replaces parameters, or writes into them.
        """
        copied = Call(self.module, call.method, call.layout, call.names, call.args, call.kwargs, call.kinds)
        placed, versions, results = list[tuple[dict[str, Any], str, Any]](), list[int](), []
        items = items_of(self._containers)
        try:
            with _unobserved_hooks() if mode else contextlib.nullcontext(), mode or contextlib.nullcontext():
                for rows, parameters in zip(parts, values, strict=True):
                    placed = self.fill(parameters)
                    versions = versions or _versions(placed)
                    results.append(copied.run(rows))
                    self._restore_attributes()
                    restore_items(items)
        finally:
            self._check(call.name, placed, versions)
            self._restore_attributes()
            restore_items(items)
        return results

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
        for place, twin, members in self._assignable:
            attributes = vars(twin)
            if attributes.keys() != members.keys() or not all(map(operator.is_, attributes.values(), members.values())):
                for name, value in members.items():
                    new = attributes.get(name)
                    if type(value) in (int, float) and type(new) in (int, float) and new != value:
                        self.assigned[place, name] = new
                attributes.clear()
                attributes.update(members)

    def fill(self, values: Mapping[int, Any]) -> list[tuple[dict[str, Any], str, Any]]:
        """Replaces each parameter whose id is in ``values``; lists (registry, name, tensor) of the replacements."""
        placed = [(registry, name, values[key]) for registry, name, key in self._places if key in values]
        for registry, name, value in placed:
            registry[name] = value
        for attributes, members, name, value in self._held:
            attributes[name] = members[name] = moved(value, values)
        return placed

    def replace(self, place: int, name: str, value: Any) -> None:
        """Replaces an attribute or a buffer of a submodule in all later runs."""
        part = self.parts[place]
        registries = [vars(part), *(members for at, _, members in self._assignable if at == place)]
        for registry in registries if name in vars(part) else [part._buffers]:
            registry[name] = value

    def end(self) -> None:
        """Removes the parameters, so that the module's code fails if the backward pass runs it again."""
        for registry, _, _ in self._places:
            registry.clear()


def _twin(part: nn.Module, place: int, reads: set[tuple[int, str]] | None, writes: dict[Any, Any]) -> nn.Module:
    """Returns an empty object of a submodule's class, or the submodule itself if it holds nothing that changes."""
    empty = not (part._parameters or part._modules or part._buffers)
    plain = empty and type(part).__module__.startswith(_LAYERS) and reads is None
    if plain or isinstance(part, torch.jit.ScriptModule):
        return part
    kind = type(part) if reads is None else _recording_class(type(part), place, reads, writes)
    twin: nn.Module = object.__new__(kind)
    return twin


class _Unregistered:
    """A class whose ``__init_subclass__`` does nothing."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        pass


def observed_class(kind: Any, read: Callable[[Any, str], None], write: Callable[[str], None] | None = None) -> Any:
    """Makes a subclass of the same memory layout that reports accesses to attributes.

    Many classes register their subclasses in ``__init_subclass__``; this subclass does not appear in such a registry.

    Args:
        kind: The class.
        read: A function of the object and a name, called before each read of an attribute.
        write: A function of a name, called before each assignment to an attribute; None for no call.
    """

    class Unlisted(type(kind)):  # type: ignore[misc]
        def mro(cls) -> list[type]:
            return [cls, _Unregistered, *kind.__mro__]

    def getattribute(self: Any, name: str) -> Any:
        read(self, name)
        return kind.__getattribute__(self, name)

    def set_attribute(self: Any, name: str, value: Any) -> None:
        write(name)  # type: ignore[misc]
        kind.__setattr__(self, name, value)

    members = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "__getattribute__": getattribute}
    return Unlisted(kind.__name__, (kind,), members if write is None else {**members, "__setattr__": set_attribute})


def _recording_class(
    kind: type[nn.Module], place: int, reads: set[tuple[int, str]], writes: dict[Any, Any]
) -> type[nn.Module]:
    """Makes a subclass that records accesses to attributes; see :class:`Double`."""

    def write(name: str) -> None:
        if (place, name) in reads:
            frame = sys._getframe(2)
            writes.setdefault((place, name), (frame.f_code.co_filename, frame.f_lineno))

    recording: type[nn.Module] = observed_class(kind, lambda _, name: reads.add((place, name)), write)
    return recording


def _unobserved_hooks() -> Any:
    """Returns a context in which function modes do not see what saved-tensor hooks call.

    A hook of ``torch.utils.checkpoint`` calls ``detach`` where a custom autograd function saves a tensor.
    """
    hooks: Any = torch._C._autograd._top_saved_tensors_default_hooks(False)
    if hooks is None:
        return contextlib.nullcontext()
    pack, unpack = hooks

    def unobserved(tensor: Tensor) -> Any:
        with torch._C.DisableTorchFunction():
            return pack(tensor)

    return torch.autograd.graph.saved_tensors_hooks(unobserved, unpack)


def _versions(placed: list[tuple[dict[str, Any], str, Any]]) -> list[int]:
    """Lists the version counters of tensors; this must be fast, since a loop over cells does it hundreds of times."""
    try:
        return [value._version for _, _, value in placed]
    except RuntimeError:  # inference-mode tensors have no version counter
        return [0] * len(placed)


def _nothing() -> None:
    """Does nothing."""


def items_of(containers: Iterable[Any]) -> list[tuple[Any, Any]]:
    """Lists (container, copy) for all lists, dicts and sets, including nested ones."""
    pending, items = list(containers), dict[int, tuple[Any, Any]]()
    while pending:
        container = pending.pop()
        if isinstance(container, (list, dict, set)) and id(container) not in items:
            items[id(container)] = container, container.copy()
            pending += container.values() if isinstance(container, dict) else container
    return list(items.values())


def restore_items(items: list[tuple[Any, Any]]) -> None:
    """Restores containers from the copies of :func:`items_of`."""
    for container, copied in items:
        container.clear()
        container.extend(copied) if isinstance(container, list) else container.update(copied)


def moved(value: Any, twins: Mapping[int, Any]) -> Any:
    """Returns the value with submodules and tensors replaced by the ``twins`` of their ids."""

    def change(name: str, leaf: Any, nested: bool) -> Any:
        if isinstance(leaf, (nn.Module, Tensor)):
            return twins.get(id(leaf), leaf)
        if isinstance(leaf, types.MethodType):
            return types.MethodType(leaf.__func__, moved(leaf.__self__, twins))
        if isinstance(leaf, functools.partial):
            return functools.partial(moved(leaf.func, twins), *moved(leaf.args, twins), **moved(leaf.keywords, twins))
        if isinstance(leaf, (set, frozenset)):
            return type(leaf)(moved(item, twins) for item in leaf)
        if callable(leaf) and type(leaf) not in _PLAIN and not isinstance(leaf, type) and hasattr(leaf, "__dict__"):
            new: Any = object.__new__(type(leaf))
            vars(new).update({name: moved(item, twins) for name, item in vars(leaf).items()})
            return new
        return leaf

    return map_tree(value, change)
