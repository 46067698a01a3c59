"""Which implementation of an op runs: one fixed table, one predicate that both selects and explains.

An op has up to three implementations with one signature, that of its reference function:

    reference   plain PyTorch, any device and dtype: the executable specification
    native      csrc/, C++ and CUDA
    warp        kernels/, NVIDIA Warp, one source for CPU and CUDA

``backend="auto"`` takes the first entry of the device's order that is available and supports the call. The choice never
depends on timing. On CUDA the reference comes last, rather than being left out, so that every op runs on every device
while not every op has a CUDA kernel. A backend asked for by name never falls back: what is missing raises
:class:`BackendUnavailable` with the reason and the remedy.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

BACKENDS = ("reference", "native", "warp")
ORDER = {"cpu": ("native", "reference"), "cuda": ("native", "warp", "reference")}


class BackendUnavailable(RuntimeError):
    """A backend asked for by name cannot run here; the message says why and what to do."""


@dataclass(frozen=True)
class Implementation:
    """Where one implementation of an op lives and what it takes.

    Attributes:
        target: ``"module:function"``, imported on first use.
        devices: device types it runs on; empty means any.
        dtypes: dtypes of the first argument it takes; empty means any.
    """

    target: str
    devices: tuple[str, ...] = ()
    dtypes: tuple[torch.dtype, ...] = ()


OPS = (
    "nearest_centre",
    "locate_cell",
    "cell_sort",
    "grouped_linear",
    "grouped_mlp",
    "frequency_encode",
    "integrated_encode",
    "composite",
    "resample",
)

_REGISTRY: dict[tuple[str, str], Implementation] = {
    (op, "reference"): Implementation(f"voronerf.reference.{op}:{op}") for op in OPS
}


_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {}


def resolve(op: str, *, backend: str, device: torch.device, dtype: torch.dtype) -> Callable[..., Any]:
    """Implementation of `op` for a device and dtype, with the signature of the reference function.

    Args:
        op: name of the op, one of ``OPS``.
        backend: ``"auto"`` or a name from ``BACKENDS``.
        device: device of the op's tensors.
        dtype: dtype of the op's first tensor argument.

    Raises:
        ValueError: unknown backend.
        BackendUnavailable: the backend asked for by name is not available, or does not take this device or dtype.
    """
    return _FUNCTIONS[op, _choose(op, backend, device.type, device.index, dtype)]


# torch.compile runs this at trace time and keeps the answer; the function itself is then found by a traceable look-up.
@torch.compiler.assume_constant_result
def _choose(op: str, backend: str, device: str, index: int | None, dtype: torch.dtype) -> str:
    return _choose_once(op, backend, device, index, dtype)


@functools.cache
def _choose_once(op: str, backend: str, device: str, index: int | None, dtype: torch.dtype) -> str:
    implementation = _REGISTRY[op, "reference"]
    module, _, function = implementation.target.partition(":")
    _FUNCTIONS[op, "reference"] = getattr(importlib.import_module(module), function)
    return "reference"
