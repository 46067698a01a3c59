"""The arguments of a field's call: which belong to samples, which to rays, and how they are put in another order.

n samples in leading dimensions ``lead``, e.g. (rays, samples of a ray); f features. A module that is called with
[rays, samples, f] and [rays, f] sees [n, 1, f] and [n, f] sorted by cell: n rays of one sample each, so that code which
counts dimensions goes on working.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.router.grouping import Grouping

_OP = "VoronoiRouter"
SAMPLE, RAY, BROADCAST, SHARED = "sample", "ray", "broadcast", "shared"
_DEEPEST = 6  # objects within objects that are searched for tensors


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the tensors of a call are laid out.

    Attributes:
        lead: leading dimensions of a tensor with an entry for each sample.
        per_ray: names of the arguments with an entry for each ray, or None to tell by shapes.
        shared: names of the arguments that are the same for all samples.
        flat: for each tensor of a result, whether it is to stay [n, ...].
    """

    lead: tuple[int, ...]
    per_ray: frozenset[str] | None
    shared: frozenset[str]
    flat: tuple[bool, ...] = ()

    @property
    def n(self) -> int:
        """Samples."""
        return math.prod(self.lead)

    def kind(self, name: str, tensor: Tensor, nested: bool) -> str:
        """What a tensor has an entry for: each sample, each ray, or neither.

        Args:
            name: of the argument; of a field of an object, "argument.field".
            tensor: the argument.
            nested: inside of an object, where what fits nothing is left alone.

        Raises:
            ValueError: for a tensor that fits nothing, or two readings.
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
        """[n, ...] of a tensor per sample, [rays, ...] of one per ray."""
        d = len(self.lead)
        if kind == RAY:
            return tensor.reshape(math.prod(self.lead[:-1]), *tensor.shape[d - 1 :])
        if kind == BROADCAST:
            tensor = tensor.expand(*self.lead, *tensor.shape[d:])
        return tensor.reshape(self.n, *tensor.shape[d:])

    def arrange(self, rows: Tensor, kind: str) -> Tensor:
        """Rows [n, ...] as the module sees them, [n, 1, ...] where samples have rays."""
        ones = max(len(self.lead) - (2 if kind == RAY else 1), 0)
        return rows.reshape(rows.shape[0], *[1] * ones, *rows.shape[1:]) if ones else rows

    def restore(self, rows: Tensor, number: int) -> Tensor:
        """Tensor ``number`` of a result, [n, 1, ...] in the original order, with the leading dimensions of the call."""
        if len(self.lead) == 1 or (number < len(self.flat) and self.flat[number]):
            return rows
        ones = len(self.lead) - 1
        extra = rows.shape[1:]
        dropped = next((i for i, size in enumerate(extra[:ones]) if size != 1), min(ones, len(extra)))
        return rows.reshape(*self.lead, *extra[dropped:])


def _named(name: str, names: Iterable[str]) -> bool:
    return any(name == known or name.startswith(f"{known}.") for known in names)


def _sizes(shape: Sequence[int], empty: str = "") -> str:
    return ", ".join(str(size) for size in shape) or empty


class Reordering:
    """Rows of a call's arguments in the order of a grouping.

    Args:
        layout: of the call.
        grouping: of its samples; None keeps the original order.
        mark: called with every tensor of rows that the module will see.
    """

    def __init__(self, layout: Layout, grouping: Grouping | None, mark: Callable[[Tensor], Any]) -> None:
        self.layout, self.mark = layout, mark
        self.grouping = grouping
        self.n = max(layout.n, 2) if grouping is None else grouping.n
        self._rays: Tensor | None = None

    def _ray_of_rows(self, device: torch.device) -> Tensor:
        if self._rays is None:
            grouping = self.grouping or Grouping(None, self.layout.n, 1, device, "auto")
            self._rays = grouping.rays(self.layout.lead[-1])
        return self._rays

    def tensor(self, name: str, tensor: Tensor, nested: bool = False) -> Tensor:
        """A tensor as the module sees it."""
        kind = self.layout.kind(name, tensor, nested)
        if kind == SHARED:
            return tensor
        rows = self.rows(tensor, kind)
        self.mark(rows)
        return rows

    def rows(self, tensor: Tensor, kind: str) -> Tensor:
        """[n, 1, ...] of a tensor per sample or per ray."""
        flat = self.layout.flatten(tensor, kind)
        if self.layout.n < 2:
            # The module is run on two rows or more, since sizes of 0 and 1 leave open what is a row.
            rows = flat[:1].expand(self.n, *flat.shape[1:]).clone() if flat.shape[0] else _placeholder(flat)
        elif kind == RAY:
            rows = flat.index_select(0, self._ray_of_rows(flat.device))
        else:
            rows = flat if self.grouping is None else self.grouping.sort(flat)
            rows = rows.view_as(rows) if rows is flat else rows  # a tensor of its own, to be marked
        return self.layout.arrange(rows, kind)

    def value(self, name: str, value: Any, nested: bool = False) -> Any:
        """An argument of any type as the module sees it; what holds no rows is passed on."""
        if isinstance(value, Tensor):
            return self.tensor(name, value, nested)
        if isinstance(value, (list, tuple)) and not isinstance(value, torch.Size):
            items = [self.value(f"{name}.{i}", item, nested) for i, item in enumerate(value)]
            if all(item is old for item, old in zip(items, value)):
                return value
            return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
        if isinstance(value, dict):
            changed = {key: self.value(f"{name}.{key}", item, nested) for key, item in value.items()}
            return with_items(value, changed)
        if not _holds_attributes(value) or name.count(".") >= _DEEPEST:
            return value
        if is_batch(value):
            return self._batch(value)
        return self._object(name, value)

    def _batch(self, value: Any) -> Any:
        """An object that can be flattened, indexed and reshaped as a whole, as nerfstudio's TensorDataclass can."""
        shape, lead, n = tuple(value.shape), self.layout.lead, self.layout.n
        if shape not in (lead, lead[:-1]) or not shape:
            return value
        flat = value.flatten()
        device = next((tensor.device for tensor in tensors_of(value)), torch.device("cpu"))
        if n < 2:
            if n == 0:
                return self._object("", value)
            flat = flat[torch.zeros(self.n, dtype=torch.int64, device=device)]
        elif shape != lead:
            flat = flat[self._ray_of_rows(device).long()]
        elif self.grouping is not None:
            flat = flat[self.grouping.sort(torch.arange(n, device=device))]
        ones = len(shape) - 1
        rows = flat.reshape((self.n, *[1] * ones)) if ones else flat
        for tensor in tensors_of(rows):
            if tensor.dim() > 0 and tensor.shape[0] == self.n:
                self.mark(tensor)
        return rows

    def _object(self, name: str, value: Any) -> Any:
        """An object with tensors among its attributes, rebuilt with their rows in order."""
        names = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else list(vars(value))
        changed = {}
        for key in names:
            old = getattr(value, key, None)
            new = self.value(f"{name}.{key}", old, nested=True)
            if new is not old:
                changed[key] = new
        if not changed:
            return value
        if dataclasses.is_dataclass(value):
            given = {f.name for f in dataclasses.fields(value) if f.init}
            early = {key: changed.pop(key) for key in given & changed.keys()}
            rebuilt = dataclasses.replace(cast(Any, value), **early)
            for tensor in tensors_of(rebuilt):  # __post_init__ may have made new tensors of those given
                if tensor.dim() > 0 and tensor.shape[0] == self.n:
                    self.mark(tensor)
        else:
            rebuilt = copy.copy(value)
        for key, new in changed.items():
            object.__setattr__(rebuilt, key, new)
        return rebuilt


def with_items(value: dict[Any, Any], items: dict[Any, Any]) -> dict[Any, Any]:
    """A dict with other items under its keys, of its own class; itself where none differs."""
    if all(items[key] is item for key, item in value.items()):
        return value
    if type(value) is dict:
        return items
    try:
        changed = copy.copy(value)
    except Exception:  # one that takes attributes for items, before Python 3.11
        changed = type(value).__new__(type(value))
        changed.update(value)
    changed.update(items)
    return changed


def is_batch(value: Any) -> bool:
    """Whether an object has ``shape``, ``flatten()``, ``reshape(shape)`` and indexing of its own."""
    if isinstance(value, (Tensor, type)) or not isinstance(getattr(value, "shape", None), (tuple, torch.Size)):
        return False
    return all(callable(getattr(value, name, None)) for name in ("flatten", "reshape", "__getitem__"))


def _holds_attributes(value: Any) -> bool:
    """Whether an argument is an object whose attributes may be tensors."""
    return hasattr(value, "__dict__") and not isinstance(value, (type, nn.Module)) and not callable(value)


def tensors_of(value: Any, depth: int = 0) -> list[Tensor]:
    """All tensors of an argument or a result, also inside of objects."""
    if isinstance(value, Tensor):
        return [value]
    if depth > _DEEPEST:
        return []
    if isinstance(value, dict):
        return [tensor for item in value.values() for tensor in tensors_of(item, depth + 1)]
    if isinstance(value, (list, tuple)):
        return [tensor for item in value for tensor in tensors_of(item, depth + 1)]
    if not _holds_attributes(value):
        return []
    return [tensor for item in vars(value).values() for tensor in tensors_of(item, depth + 1)]


def narrow(value: Any, rows: Callable[[Tensor], bool], first: int, last: int) -> Any:
    """Rows ``first`` to ``last`` of everything that has rows in an argument as the module sees it."""
    if isinstance(value, Tensor):
        return value[first:last] if rows(value) else value
    if isinstance(value, dict):
        return with_items(value, {key: narrow(item, rows, first, last) for key, item in value.items()})
    if isinstance(value, (list, tuple)) and not isinstance(value, torch.Size):
        items = [narrow(item, rows, first, last) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    if not _holds_attributes(value) or not any(rows(t) for t in tensors_of(value)):
        return value
    if is_batch(value):
        return value[first:last]
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value) if f.init]
        fields = {name: narrow(getattr(value, name), rows, first, last) for name in names}
        return dataclasses.replace(cast(Any, value), **fields)
    part = copy.copy(value)
    for key, item in vars(value).items():
        object.__setattr__(part, key, narrow(item, rows, first, last))
    return part


def map_result(value: Any, change: Callable[[Any], Any], leaf: type | tuple[type, ...] = Tensor, depth: int = 0) -> Any:
    """A result of any structure (tuple, named tuple, list, dict, object) with every tensor, or ``leaf``, changed.

    What holds none is passed on as it is.
    """
    if isinstance(value, leaf):
        return change(value)
    if isinstance(value, dict):
        old = value
    elif isinstance(value, (list, tuple)) and not isinstance(value, torch.Size):
        old = dict(enumerate(value))
    elif _holds_attributes(value):
        old = vars(value)
    else:
        return value
    if depth > _DEEPEST:
        return value
    new = {key: map_result(item, change, leaf, depth + 1) for key, item in old.items()}
    if isinstance(value, dict):
        return with_items(value, new)
    if all(new[key] is item for key, item in old.items()):
        return value
    if isinstance(value, (list, tuple)):
        parts = list(new.values())
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    changed = copy.copy(value)
    for key, item in new.items():
        object.__setattr__(changed, key, item)
    return changed


def argument_names(function: Callable[..., Any], count: int) -> list[str]:
    """Names of the first positional arguments of a function; their numbers where it does not name them."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return [str(i) for i in range(count)]
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    names = [parameter.name for parameter in parameters if parameter.kind in kinds]
    return [names[i] if i < len(names) else str(i) for i in range(count)]


def accepted_names(functions: Sequence[Callable[..., Any]]) -> list[str] | None:
    """The names of the arguments that any of some functions take; None where one takes any name."""
    names: dict[str, None] = {}
    for function in functions:
        try:
            parameters = inspect.signature(function).parameters.values()
        except (TypeError, ValueError):
            return None
        if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters):
            return None
        names |= dict.fromkeys(parameter.name for parameter in parameters)
    return list(names)


def _placeholder(empty: Tensor) -> Tensor:
    """Two rows in the place of none, so that a module that is never called without rows gives its sizes."""
    rows = empty.new_full((2, *empty.shape[1:]), 0.5 if empty.is_floating_point() else 0)
    # Joined, so that results depend on the argument as those of any other call do.
    return torch.cat([empty, rows])
