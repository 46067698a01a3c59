"""Counts kernel launches and host reads of a piece of work without a GPU.

The emulation counts the kernels of this project. Each computing operation of torch counts as one launch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from emulated import emulated
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf.ops._core import native as _native

aten = torch.ops.aten
READING = {
    *(aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default),
    *(aten.is_nonzero.default, aten._unique2.default, aten.repeat_interleave.Tensor, aten.lift_fresh.default),
}
"""Operations with which the host reads a number or a size from the device, or copies a number to it (lift_fresh)."""
FREE = {
    *("empty", "empty_like", "new_empty", "empty_strided", "new_empty_strided", "_unsafe_view", "detach"),
    *("promote_types", "_record_function_enter_new", "_record_function_exit"),
}
"""Operations that launch nothing: allocations, views and bookkeeping."""


def reads(function: Any, args: Any) -> bool:
    """Returns whether a call makes the host wait for the device."""
    masks = args[1] if function is aten.index.Tensor else ()
    by_bool = any(index is not None and index.dtype == torch.bool for index in masks)
    return by_bool or function in READING


class Asked(TorchDispatchMode):
    """A dispatch mode that counts torch's operations.

    Attributes:
        operations: The number of calls of each computing operation, by name.
        reads: The number of calls of each operation that the host waits for.
        kernels: The number of launches of each compiled function.
        on_cpu: The number of calls of each compiled function without a CUDA kernel.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations: Counter[str] = Counter()
        self.reads: Counter[str] = Counter()
        self.kernels: Counter[str] = Counter()
        self.on_cpu: Counter[str] = Counter()

    @property
    def launches(self) -> int:
        """The launches of this project's and torch's kernels."""
        return self.kernels.total() + self.operations.total()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        name = function.overloadpacket.__name__
        if reads(function, args):
            self.reads[name] += 1
        elif not function.is_view and name not in FREE:
            self.operations[name] += 1
        return function(*args, **(kwargs or {}))


class Watched:
    """A wrapper of the compiled module, which counts the launches of each function."""

    def __init__(self, compiled: Any, module: Any, counted: Asked) -> None:
        self._compiled, self._module, self._counted = compiled, module, counted

    def __getattr__(self, name: str) -> Any:
        entry = getattr(self._compiled, name)
        if isinstance(entry, type) or not callable(entry):
            return entry

        def call(*arguments: Any) -> Any:
            before = self._module.launches()
            result = entry(*arguments)
            launched = self._module.launches() - before
            if launched:
                self._counted.kernels[name] += launched
            elif any(isinstance(argument, _native.compiled.Cpu) for argument in arguments):
                self._counted.on_cpu[name] += 1
            return result

        return call


@contextmanager
def asked() -> Iterator[Asked]:
    """Counts launches and reads of the emulated GPU inside the block, also of operations inside custom ops."""
    with emulated() as module, mock.patch("voronerf.ops._core.custom_op.LISTENERS", []):
        counted = Asked()
        with mock.patch.object(_native, "compiled", Watched(_native.compiled, module, counted)), counted:
            yield counted
