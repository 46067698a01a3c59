"""NVIDIA Warp kernels, installed as ``voronerf.kernels``: one file per op, one source for CPU and CUDA.

They are for machines with a GPU but no CUDA compiler. On the CPU, where Warp has one thread, they serve as a check.
Importing this package raises ``BackendUnavailable`` if Warp is missing or too old; ``import voronerf`` imports neither
this package nor Warp.

A file's kernels are compiled on first use, or by :func:`loads`. Compiled kernels stay in Warp's cache, in the folder
WARP_CACHE_PATH or Warp's default.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import torch

from voronerf.ops._core.backends import BackendUnavailable

MINIMUM = (1, 19)
_REMEDY = "install it with `pip install 'voronerf[warp]'` (warp-lang >= 1.19)"

try:
    import warp as wp
except ImportError as error:
    raise BackendUnavailable(f"NVIDIA Warp is not installed; {_REMEDY}") from error

_VERSION: str = getattr(wp, "__version__", None) or wp.config.version
if tuple(int(part) for part in _VERSION.split(".")[:2]) < MINIMUM:
    raise BackendUnavailable(f"NVIDIA Warp {_VERSION} is too old; {_REMEDY}")


#: The line that Warp's C++ code prints to standard error on every machine without a GPU; no option turns it off.
_NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Forwards writes to file descriptor 2 inside the context, except Warp's line about the missing driver."""
    try:
        before = os.dup(2)
    except OSError:  # there is no standard error
        yield
        return
    with tempfile.TemporaryFile() as written, os.fdopen(before, "wb") as stderr:
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(before, 2)
            written.seek(0)
            stderr.writelines(line for line in written if not line.startswith(_NO_DRIVER))


# Silence the banner and the notes on compilation, unless the user has changed the log level. Older releases have
# `quiet` instead.
if not hasattr(wp.config, "log_level"):
    wp.config.quiet = True
elif wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING
with _without_driver_warning():
    wp.init()


def missing(device: torch.device) -> str | None:
    """Returns the reason why Warp cannot run on a device, with the remedy, or None if it can."""
    if device.type == "cuda" and not wp.is_cuda_available():
        return "this build of NVIDIA Warp sees no CUDA driver; install warp-lang from PyPI and check the driver"
    return None


def describe() -> dict[str, Any]:
    """Returns Warp's version, its devices and the folder of compiled kernels."""
    return {
        "version": _VERSION,
        "devices": [str(device) for device in wp.get_devices()],
        "cache": str(wp.config.kernel_cache_dir),
    }


_STEP_FILES = (
    *("nearest_centre", "locate_cell", "cell_sort", "hash_encode", "frequency_encode"),
    *("march_rays", "observe_occupancy", "render_loss"),
)


def loads(device: torch.device, dtype: torch.dtype) -> list[Callable[[], None]]:
    """Returns functions that load the kernels of a training step for a dtype of weights.

    Each function loads one module of kernels. It compiles the module first if Warp's cache does not hold it.
    """
    from voronerf.kernels.network import THREADS, kernels

    where = wp.device_from_torch(device)
    names = [f"voronerf.kernels.{name}" for name in _STEP_FILES]
    for name in names:
        importlib.import_module(name)
    files = [functools.partial(wp.load_module, name, where) for name in names]
    return files + [functools.partial(wp.force_load, where, [part.module], THREADS) for part in kernels(dtype)]
