"""The state of a module that is no parameter, as a key: flags, numbers and buffers that its ``forward`` may depend on.

What a key cannot see: globals, attributes of classes, what functions close over, objects deeper than four levels or
with more than 64 entries, what comes after the first 512 values in all, what objects without a ``__dict__`` hold (as
arrays of numpy do), and writes through ``.data`` to tensors of more than 64 numbers or on another device.
"""

from __future__ import annotations

import weakref
from typing import Any

import torch
from torch import Tensor, nn

_SIMPLE = (bool, int, float, str, bytes, type(None))
_OWN = frozenset(vars(nn.Module())) - {"training"}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_DEEPEST, _LARGEST, _MOST = 4, 64, 512


class Same:
    """An object in a key, equal to itself alone; not its ``id``, which would go to another object after its end.

    It is not kept alive where Python has weak references to it; what is gone is equal to nothing.
    """

    __slots__ = ("_hash", "_value")

    def __init__(self, value: Any) -> None:
        self._hash = id(value)
        try:
            self._value: Any = weakref.ref(value)
        except TypeError:
            self._value = lambda: value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self._value() is not None and self._value() is other._value()

    def __hash__(self) -> int:
        return self._hash


class Snapshot:
    """Reads the attributes of a module and all of its parts.

    Args:
        module: whose parts stay the same; see :meth:`key`.
    """

    def __init__(self, module: nn.Module) -> None:
        self._parts = [vars(part) for part in module.modules()]
        self._hooks = [attributes[name] for attributes in self._parts for name in _HOOKS]
        self._buffers = [attributes["_buffers"] for attributes in self._parts if attributes["_buffers"]]
        self._children = [(attributes["_modules"], dict(attributes["_modules"])) for attributes in self._parts]
        self._lengths = [len(attributes) for attributes in self._parts]
        self._places = [(attributes, name) for attributes in self._parts for name in attributes if name not in _OWN]

    def key(self) -> tuple[Any, ...] | None:
        """The present values, to be compared; None where a part has hooks, or parts or attributes have come or gone.

        Keys of one snapshot differ from those of any other.
        """
        if any(self._hooks) or self._lengths != [len(attributes) for attributes in self._parts]:
            return None
        for now, before in self._children:
            if len(now) != len(before) or any(now.get(name) is not child for name, child in before.items()):
                return None
        reader = _Reader()
        values = [reader.read(attributes[name]) for attributes, name in self._places]
        buffers = [reader.read(buffer) for owned in self._buffers for buffer in owned.values()]
        return (Same(self), *values, *buffers)


class _Reader:
    """Values as parts of a key, up to so many in all."""

    def __init__(self) -> None:
        self._left = _MOST

    def read(self, value: Any, depth: int = 0) -> Any:
        if isinstance(value, _SIMPLE):
            return value
        self._left -= 1
        if isinstance(value, Tensor):
            return tensor_key(value)
        if depth >= _DEEPEST or isinstance(value, (nn.Module, type)) or callable(value):
            return Same(value)
        if isinstance(value, (set, frozenset)) and all(isinstance(item, _SIMPLE) for item in value):
            return type(value), frozenset(value)
        own: Any = None
        if isinstance(value, (list, tuple)):
            items, own = dict(enumerate(value)), type(value)
        elif isinstance(value, dict):
            items, own = value, type(value)
        else:
            items = getattr(value, "__dict__", {})
            own = Same(value) if type(value).__weakrefoffset__ or not items else type(value)
        if not items or len(items) > min(_LARGEST, self._left):
            return own if not items else Same(value)
        self._left -= len(items)
        return own, tuple((self.read(key, depth + 1), self.read(item, depth + 1)) for key, item in items.items())


def tensor_key(tensor: Tensor) -> Any:
    """A tensor by its identity, its version, and its numbers where they are few and at hand."""
    version = None if tensor.is_inference() else tensor._version
    few = tensor.device.type == "cpu" and tensor.numel() <= _LARGEST and tensor.layout is torch.strided
    if not few:
        return Same(tensor), version, None
    # as bytes: a number that is none differs from itself
    numbers = tensor.detach().resolve_conj().resolve_neg().flatten().contiguous()
    return Same(tensor), version, numbers.view(torch.uint8).numpy().tobytes()
