"""The CUDA half of the native backend on CPU tensors: ``with emulated(): voronerf.nearest_centre(...)``.

Everything from the public function to the kernel is what runs on a GPU; only the compiled module is the emulated one,
and the question whether a tensor is on CUDA is answered with yes.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any
from unittest import mock

from emulation_build import build, load

from voronerf.ops._core import native as _native
from voronerf.ops.grouped_program import native as _programs


@functools.cache
def module() -> ModuleType:
    """The emulated module, built if need be."""
    loaded = load(build())
    _native.know_torch(loaded)
    return loaded


class _Both:
    """The compiled module with the emulated entries over its own."""

    def __init__(self, over: Any, under: Any) -> None:
        self._over, self._under = over, under

    def __getattr__(self, name: str) -> Any:
        return getattr(self._over if hasattr(self._over, name) else self._under, name)


@contextmanager
def emulated(
    *, seed: int = 0, capability: int = 90, compiled: int = 120, shared_bytes: int = 227 * 1024
) -> Iterator[ModuleType]:
    """The native backend on the emulated device: its compute capability and shared memory of a block.

    ``compiled``: the architecture that the kernels are compiled for.
    """
    loaded = module()
    loaded.seed(seed)
    loaded.device(capability, compiled, shared_bytes)
    _forget()
    with (
        mock.patch.object(_native, "compiled", _Both(loaded, _native.compiled)),
        mock.patch.object(_native, "on_cuda", lambda tensor: True),
        mock.patch.object(_native, "stream", lambda tensor: (loaded.current(), 0)),
    ):
        try:
            yield loaded
        finally:
            _forget()


def _forget() -> None:
    """Programs are objects of the module that made them."""
    _programs.lower.cache_clear()
    _programs._code.cache_clear()
    _programs._multiplies_halves.cache_clear()
