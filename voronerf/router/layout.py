"""The arguments of a call: their relation to its samples, their rows sorted by cell, and the order of its results.

Letters: n samples in leading dimensions ``lead``, for example (rays, samples of a ray); f features. Arguments and
results may have any structure: lists, tuples, named tuples, dicts, dataclasses, other objects.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.grouping import Grouping

_OP = "VoronoiRouter"
DEEPEST = 6  # maximum depth to which nested objects are searched for tensors
_LEAVES = {type(None), type(...), bool, int, float, str, torch.Size, torch.dtype, torch.device}
AS_TENSOR = "pass torch.as_tensor(points, dtype=torch.float32)"
SAMPLE, RAY, BROADCAST, SHARED = "sample", "ray", "broadcast", "shared"


# Structures -----------------------------------------------------------------------------------------------------------


def map_tree(value: Any, change: Callable[..., Any], name: str = "", nested: bool = False, depth: int = 0) -> Any:
    """Applies ``change`` to every leaf of a structure; returns the same object if no leaf changes.

    ``change`` gets a leaf's name ("x", "samples.origins", "views.0"), the leaf, and whether it is inside an object.
    """
    items = None if depth > DEEPEST else contents(value)
    if items is None:
        return change(name, value, nested)
    nested = nested or not isinstance(value, (dict, list, tuple))
    new = {key: map_tree(item, change, f"{name}.{key}", nested, depth + 1) for key, item in items.items()}
    return value if all(new[key] is item for key, item in items.items()) else _rebuilt(value, items, new)


def contents(value: Any) -> dict[Any, Any] | None:
    """Returns the items of a container, by key, index or attribute; None for a leaf."""
    if isinstance(value, (Tensor, int, str)):
        return None
    if isinstance(value, dict):
        return value
    if isinstance(value, (list, tuple)):
        return dict(enumerate(value))
    if callable(value):
        return None
    if dataclasses.is_dataclass(value) and not hasattr(value, "__dict__"):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return dict(vars(value)) if hasattr(value, "__dict__") else None


def reachable(value: Any, most: float = math.inf) -> Iterator[Any]:
    """Yields the modules, tensors and functions that a value holds, through containers and objects but not modules.

    Stops after ``most`` objects.
    """
    pending, seen = [value], dict[int, Any]()
    while pending and most > 0:
        item, most = pending.pop(), most - 1
        if type(item) in _LEAVES or id(item) in seen:
            continue
        seen[id(item)] = item  # keeps the item alive, and so its id
        if isinstance(item, (nn.Module, Tensor, types.FunctionType)):
            yield item
        elif isinstance(item, types.MethodType):
            pending.append(item.__self__)
        elif isinstance(item, functools.partial):
            pending += [item.func, *item.args, *item.keywords.values()]
        elif isinstance(item, dict):
            pending += item.values()
        elif isinstance(item, (list, tuple, set, frozenset)):
            pending += item
        elif not isinstance(item, (type, types.ModuleType)):
            pending += getattr(item, "__dict__", {}).values()


def _rebuilt(value: Any, items: dict[Any, Any], new: dict[Any, Any]) -> Any:
    kind: Any = tuple if isinstance(value, torch.Size) else type(value)
    if isinstance(value, dict):
        rebuilt = kind.__new__(kind)  # not copy.copy, which fails for dicts whose items are attributes
        rebuilt.update(new)
        return rebuilt
    if hasattr(value, "_fields"):
        return kind(*new.values())
    if isinstance(value, (list, tuple)):
        return kind(new.values())
    changed = {key: item for key, item in new.items() if item is not items[key]}
    if hasattr(value, "__post_init__"):  # it may derive other attributes, such as a shape
        names = {f.name for f in dataclasses.fields(value) if f.init}
        value = dataclasses.replace(value, **{key: changed.pop(key) for key in names & changed.keys()})
    rebuilt = copy.copy(value)
    for key, item in changed.items():
        object.__setattr__(rebuilt, key, item)
    return rebuilt


def tensors_of(value: Any) -> list[Tensor]:
    """Lists all tensors of a structure, in the order of :func:`map_tree`."""
    tensors: list[Tensor] = []
    _collect((value,), tensors, 0)
    return tensors


def _collect(items: Iterable[Any], tensors: list[Tensor], depth: int) -> None:
    # This runs for the arguments of every function of a grouped module, so common leaves are skipped first.
    for item in items:
        kind = type(item)
        if kind in _LEAVES:
            continue
        if isinstance(item, Tensor):
            tensors.append(item)
        elif depth <= DEEPEST:
            _collect(item if kind in (list, tuple) else (contents(item) or {}).values(), tensors, depth + 1)


def map_tensors(value: Any, change: Callable[[Tensor], Any]) -> Any:
    """Applies ``change`` to every tensor of a structure, and returns the structure."""
    return map_tree(value, lambda _, leaf, nested: change(leaf) if isinstance(leaf, Tensor) else leaf)


def as_plain(value: Any) -> Any:
    """Converts a tensor of a subclass to a plain tensor, unless the subclass has its own dispatch."""
    kind = type(value)
    if kind is Tensor or kind is nn.Parameter or not isinstance(value, Tensor):
        return value
    return value.as_subclass(Tensor) if kind.__torch_dispatch__ is Tensor.__torch_dispatch__ else value


def rebuild(value: Any, tensors: Iterable[Any]) -> Any:
    """Returns the structure with its tensors replaced, in the order of :func:`tensors_of`."""
    if isinstance(value, Tensor):
        (tensor,) = tensors
        return tensor
    if type(value) in (list, tuple) and all(isinstance(item, Tensor) for item in value):
        return type(value)(tensors)
    following = iter(tensors)
    return map_tensors(value, lambda tensor: next(following))


# Layouts --------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Layout:
    """The layout of a call's tensors, and the shapes that the module gets.

    With ``flat`` the module gets [n, f] for every argument with rows. Otherwise it gets n rays of one sample: [n, 1, f]
    for [rays, samples, f], and [n, f] for an argument per ray.
    """

    lead: tuple[int, ...]  # leading dimensions of a tensor with an entry for each sample
    per_ray: frozenset[str] | None  # names of the arguments with an entry for each ray; None: shapes decide
    shared: frozenset[str]  # names of the arguments that are the same for all samples
    flat: bool = False  # whether the module gets [n, f]

    @functools.cached_property
    def n(self) -> int:
        """The number of samples."""
        return math.prod(self.lead)

    def kind(self, name: str, tensor: Tensor, nested: bool) -> str:
        """Returns the kind of a tensor: per sample, per ray, broadcast or shared.

        A tensor whose shape fits no kind is shared if it is ``nested`` in an object; otherwise its shape raises
        ValueError. An ambiguous shape always raises ValueError.
        """
        shape, lead, d = tuple(tensor.shape), self.lead, len(self.lead)
        if not shape or _named(name, self.shared):
            return SHARED
        by_sample = shape[:d] == lead
        by_ray = d >= 2 and shape[: d - 1] == lead[:-1] and len(shape) in (d - 1, d)
        if self.per_ray is not None and _named(name, self.per_ray):
            if d < 2 or shape[: d - 1] != lead[:-1]:
                raise ValueError(
                    f"{_OP}: {name} is per ray and must have shape [{_sizes(lead[:-1], 'rays')}, ...] beside samples "
                    f"of [{_sizes(lead)}, ...], got {list(shape)}"
                )
            return RAY
        if self.per_ray is None and by_ray and self.n and lead[-1] > 1 and (by_sample or lead[-1] == lead[-2]):
            other = f"each of {lead[-1]} samples" if by_sample else "a sample's place along every ray"
            raise ValueError(
                f"{_OP}: per_ray must say what {name} is, since [{_sizes(shape)}] beside samples of "
                f"[{_sizes(lead)}, ...] may stand for rays or for {other}; pass per_ray=[{name!r}], or per_ray=[] if "
                "it is not per ray"
            )
        if by_sample:
            return SAMPLE
        if by_ray and self.per_ray is None:
            return RAY
        if tensor.numel() == 1 or all(size == 1 for size in shape[:d]):
            return SHARED
        if len(shape) >= d and all(size in (1, whole) for size, whole in zip(shape, lead)):
            return BROADCAST
        if nested:
            return SHARED
        ray = f", per ray [{_sizes(lead[:-1])}, ...]" if d >= 2 else ""
        raise ValueError(
            f"{_OP}: {name} must be per sample [{_sizes(lead)}, ...]{ray}, or named in shared=, got {list(shape)}"
        )

    def flatten(self, tensor: Tensor, kind: str) -> Tensor:
        """Reshapes a tensor per sample to [n, ...], and a tensor per ray to [rays, ...]."""
        d = len(self.lead)
        if kind == RAY:
            return tensor.reshape(math.prod(self.lead[:-1]), *tensor.shape[d - 1 :])
        if kind == BROADCAST:
            tensor = tensor.expand(*self.lead, *tensor.shape[d:])
        return tensor.reshape(self.n, *tensor.shape[d:])

    def shown(self, rows: Tensor, kind: str) -> Tensor:
        """Returns rows [n, ...] in the shape that the module gets."""
        ones = [1] * (0 if self.flat else len(self.lead) - (2 if kind == RAY else 1))
        return rows.reshape(rows.shape[0], *ones, *rows.shape[1:]) if ones else rows

    def restore(self, rows: Tensor) -> Tensor:
        """Reshapes rows of a result, in the call's order, to the leading dimensions of the call."""
        ones = 0 if self.flat else len(self.lead) - 1
        if rows.shape[1 : 1 + ones] != (1,) * ones:
            raise ValueError(
                f"{_OP}: results must keep the leading dimensions [{_sizes(self.lead)}, ...] of the arguments, but the "
                "module flattens them; layout='flat' calls it with [n, f] for [rays, samples, f]"
            )
        return rows.reshape(*self.lead, *rows.shape[1 + ones :])


def _named(name: str, names: Iterable[str]) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in names)


def _sizes(shape: Sequence[int], empty: str = "") -> str:
    return ", ".join(str(size) for size in shape) or empty


# Calls ----------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Call:
    """A method of a module with the arguments of one call, their layout, and their names."""

    module: nn.Module
    method: str
    layout: Layout
    names: list[str]  # of the arguments, positional ones first
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    kinds: dict[str, str] = dataclasses.field(default_factory=dict)  # the kind of each tensor (`Layout.kind`), by name
    key: Any = None  # cache key from `call_key`

    @property
    def name(self) -> str:
        """The method's name in messages."""
        return f"{type(self.module).__name__}.{self.method}"

    def run(self, rows: Iterable[Tensor]) -> Any:
        """Calls the method with ``rows`` instead of its arguments' rows; ``forward`` runs with the module's hooks."""
        following = iter(rows)
        args, kwargs = self.changed(lambda tensor, kind: next(following))
        return (self.module if self.method == "forward" else getattr(self.module, self.method))(*args, **kwargs)

    def _mapped(self, change: Callable[[str, Any, bool], Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Applies ``change`` to every leaf of the arguments (see :func:`map_tree`); returns the new arguments."""
        arguments = zip(self.names, (*self.args, *self.kwargs.values()), strict=True)
        values = [
            change(name, value, False) if isinstance(value, Tensor) else map_tree(value, change, name)
            for name, value in arguments
        ]
        return tuple(values[: len(self.args)]), dict(zip(self.kwargs, values[len(self.args) :]))

    def changed(self, change: Callable[[Tensor, str], Tensor]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Applies ``change`` (of a tensor and its kind) to every tensor that has rows; returns the new arguments."""

        def changed(name: str, value: Any, nested: bool) -> Any:
            if not isinstance(value, Tensor):
                return value
            if name not in self.kinds:
                self.kinds[name] = self.layout.kind(name, value, nested)
            return value if self.kinds[name] == SHARED else change(value, self.kinds[name])

        return self._mapped(changed)

    def _leaves(self) -> dict[str, Any]:
        """Returns the leaves of the arguments, by name."""
        leaves: dict[str, Any] = {}
        self._mapped(lambda name, leaf, _: leaves.setdefault(name, leaf))
        return leaves

    def constants(self) -> dict[str, Any]:
        """Returns the leaves of the arguments that are not tensors, by name."""
        return {name: leaf for name, leaf in self._leaves().items() if not isinstance(leaf, Tensor)}

    def shared(self) -> list[Tensor]:
        """Lists the tensors that are the same for all samples; call :meth:`changed` first, which finds them."""
        return [leaf for name, leaf in self._leaves().items() if self.kinds.get(name) == SHARED]

    def with_leaves(self, change: Callable[[str, Any], Any]) -> Call:
        """Returns the call with ``change(name, leaf)`` instead of each leaf of the arguments."""
        args, kwargs = self._mapped(lambda name, leaf, _: change(name, leaf))
        call = dataclasses.replace(self, args=args, kwargs=kwargs, kinds=dict(self.kinds))
        call.changed(lambda tensor, kind: tensor)
        return call

    def plain(self) -> Call:
        """Returns the call with plain tensors instead of subclasses, or itself if it has none."""
        if all(type(value) is Tensor for value in (*self.args, *self.kwargs.values())):
            return self
        args, kwargs = map_tensors((self.args, self.kwargs), as_plain)
        same = args is self.args and kwargs is self.kwargs
        return self if same else dataclasses.replace(self, args=args, kwargs=kwargs)

    def arranged(self, grouping: Grouping | None) -> list[Tensor]:
        """Lists the rows of the arguments in the module's shapes, sorted by a grouping unless it is None."""
        layout, n = self.layout, self.layout.n if grouping is None else grouping.n
        tensors: list[Tensor] = []

        @functools.cache
        def ray_rows(device: torch.device) -> Tensor:
            rows = None if grouping is None else grouping.source
            rows = torch.arange(n, dtype=torch.int32, device=device) if rows is None else rows
            return torch.div(rows, layout.lead[-1], rounding_mode="floor")

        def arrange(tensor: Tensor, kind: str) -> Tensor:
            rows = recordable(layout.flatten(tensor, kind))
            if not layout.n:  # placeholders, because no module runs without rows; the shapes of results are needed
                empty = rows.new_full((n, *rows.shape[1:]), 0.5 if rows.is_floating_point() else 0)
                rows = torch.cat([rows[:0], empty])  # concatenated, so that the autograd tape contains the argument
            elif kind == RAY:
                rows = rows.index_select(0, ray_rows(rows.device))
            elif grouping is not None:
                rows = grouping.sort(rows)
            tensors.append(layout.shown(rows.view_as(rows), kind))  # a new object, since rows get marks
            return tensor

        self.changed(arrange)
        return tensors


def recordable(tensor: Tensor) -> Tensor:
    """Returns the tensor; outside of inference mode, the copy of an inference tensor, which autograd cannot save."""
    return tensor.clone() if tensor.is_inference() and not torch.is_inference_mode_enabled() else tensor


def split_rows(rows: list[Tensor], sizes: list[int]) -> list[Sequence[Tensor]]:
    """Splits the rows of all arguments into parts of these sizes.

    A module may write into its part, if there are several; one part is the rows themselves.
    """
    return [rows] if len(sizes) == 1 else list(zip(*[t.unsafe_split_with_sizes(sizes) for t in rows], strict=True))


@dataclasses.dataclass
class Results:
    """The results of a method on rows of samples."""

    value: Any  # the results, of any structure
    tensors: list[Tensor]  # the tensors in ``value``, [n, ...]
    order: Grouping | None = None  # the grouping that sorted the rows; None: in the order of the call

    @staticmethod
    def joined(values: list[Any], counts: list[int], order: Grouping | None) -> Results:
        """Concatenates the results of a method on parts of the rows."""
        parts = [tensors_of(value) for value in values]
        if any(len(part) != len(parts[0]) for part in parts):
            raise ValueError(f"{_OP}: module must return equally many tensors for every cell, got different numbers")
        for tensor, n in ((tensor, n) for part, n in zip(parts, counts, strict=True) for tensor in part):
            if tensor.shape[:1] != (n,):
                raise ValueError(
                    f"{_OP}: results must have a row for each sample, got {list(tensor.shape)} for {n} samples"
                )
            if as_plain(tensor) is not tensor:
                kind = type(tensor).__name__
                raise TypeError(f"{_OP}: results must be plain tensors, got a {kind}; make it of the router's results")
        tensors = [torch.cat(pieces) if len(pieces) > 1 else pieces[0] for pieces in zip(*parts, strict=True)]
        return Results(values[0], tensors, order)

    @property
    def unsorted(self) -> list[Tensor]:
        """The tensors in the order of the call."""
        return self.tensors if self.order is None else [self.order.unsort(tensor) for tensor in self.tensors]

    def restored(self, layout: Layout) -> Any:
        """Returns the results in the order of the call, with its leading dimensions."""
        return rebuild(self.value, [layout.restore(rows if layout.n else rows[:0]) for rows in self.unsorted])
