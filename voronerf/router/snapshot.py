"""The state of a module that is no tensor, as a key: flags and numbers that its ``forward`` may branch on."""

from __future__ import annotations

from typing import Any

from torch import nn

_SIMPLE = (bool, int, float, str, type(None))
_OWN = frozenset(vars(nn.Module())) - {"training"}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


class Snapshot:
    """Reads the attributes of a module and all of its parts.

    Args:
        module: whose parts stay the same.
    """

    def __init__(self, module: nn.Module) -> None:
        self._parts = [vars(part) for part in module.modules()]
        self._hooks = [attributes[name] for attributes in self._parts for name in _HOOKS]
        self._buffers = [attributes["_buffers"] for attributes in self._parts if attributes["_buffers"]]
        self._lengths = [len(attributes) for attributes in self._parts]
        self._places = [(attributes, name) for attributes in self._parts for name in attributes if name not in _OWN]

    def key(self) -> tuple[Any, ...] | None:
        """The present values, to be compared; None where a part has hooks, or attributes have come or gone."""
        if any(self._hooks) or self._lengths != [len(attributes) for attributes in self._parts]:
            return None
        values = [_value(attributes[name]) for attributes, name in self._places]
        buffers = [
            (id(buffer), buffer._version)
            for owned in self._buffers
            for buffer in owned.values()
            if buffer is not None and not buffer.is_inference()
        ]
        return (*values, *buffers)


def _value(value: Any) -> Any:
    if isinstance(value, _SIMPLE):
        return value
    if isinstance(value, (list, tuple, set, dict)):
        return repr(value) if len(value) <= 64 else id(value)
    return id(value)
