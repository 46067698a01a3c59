"""Dependencies of cached results, whose changes are detected. Used by routers, fields and training steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends

_COPIED = 1 << 20  # maximum number of bytes of a tensor whose values are copied and compared


class Stale:
    """Dependencies that never hold, for use without the compiled module: every call checks everything itself."""

    def holds(self) -> bool:
        """Returns False, since no objects are noted."""
        return False

    def _note(self, *noted: Any) -> None:
        """Ignores the objects, since the dependencies never hold."""

    contents = entries = attributes = answer = place = layout = values = kind = _note


def unchanged() -> Any:
    """Creates empty dependencies; csrc/bindings/unchanged.h lists the properties that can be noted."""
    module = backends.compiled()
    return Stale() if module is None else module.compiled.Unchanged()


class Values:
    """The values of a tensor at one time.

    Small tensors on the CPU are copied and compared, since no version counter counts writes through ``tensor.data`` or
    into inference tensors. For other tensors, the address and the version counter are compared.

    Args:
        tensor: The tensor.
        most: The maximum number of bytes that are copied.

    Attributes:
        tensor: The tensor, whose values may change later.
        copy: The copied values, or None.
    """

    def __init__(self, tensor: Tensor, most: float = _COPIED) -> None:
        self._is_plain = type(tensor) in (Tensor, torch.nn.Parameter) and tensor.layout is torch.strided
        is_copied = self._is_plain and tensor.is_cpu and tensor.nbytes <= most
        self.tensor = tensor
        self.copy = tensor.detach().clone(memory_format=torch.contiguous_format) if is_copied else None
        self._mark = self._marked()

    def _marked(self) -> tuple[int, int]:
        version = 0 if self.tensor.is_inference() else self.tensor._version  # inference tensors have no version
        return self.tensor.data_ptr() if self._is_plain else 0, version

    def note(self, noted: Any) -> None:
        """Adds the tensor to dependencies, which then detect other values than when this object was made."""
        if self.copy is not None:
            noted.values(self.tensor, self.copy)
            return
        if self._is_plain:
            noted.place(self.tensor)
        if not self.tensor.is_inference():
            noted.attributes(self.tensor, ["_version"])

    def changed(self) -> bool:
        """Returns whether the tensor has other values than when this object was made."""
        if self.copy is None:
            return self._marked() != self._mark
        noted = unchanged()
        noted.values(self.tensor, self.copy)
        return not (noted.holds() or _same_bytes(self.copy, self.tensor))


def _same_bytes(one: Tensor, other: Tensor) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    return torch.equal(*(x.detach().contiguous().reshape(-1).view(torch.uint8) for x in (one, other)))
