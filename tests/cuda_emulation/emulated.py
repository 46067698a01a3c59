"""Runs the CUDA half of the native backend on CPU tensors: ``with emulated(): voronerf.nearest_centre(...)``.

All code from the public function to the kernel is the code that runs on a GPU. Only the compiled module is replaced by
the emulation, and CPU tensors count as CUDA tensors.
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
from voronerf.ops.network import native as _programs


@functools.cache
def module() -> ModuleType:
    """Returns the emulated module; builds it if necessary."""
    loaded = load(build())
    _native.register_torch(loaded)
    return loaded


class _Both:
    """A module with the entries of two modules: the emulated one (``over``) takes precedence over the compiled one."""

    def __init__(self, over: Any, under: Any) -> None:
        self._over, self._under = over, under

    def __getattr__(self, name: str) -> Any:
        return getattr(self._over if hasattr(self._over, name) else self._under, name)


@contextmanager
def emulated(
    *, seed: int = 0, capability: int = 90, compiled: int = 120, shared_bytes: int = 227 * 1024
) -> Iterator[ModuleType]:
    """Runs the native backend on the emulated device inside the block.

    Args:
        seed: The seed of the thread order.
        capability: The compute capability of the device.
        compiled: The architecture that the kernels are compiled for.
        shared_bytes: The bytes of shared memory per block.
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
    """Clears the caches of programs, which belong to the module that made them."""
    _programs.lower.cache_clear()
    _programs._code.cache_clear()
    _programs._multiplies_halves.cache_clear()
