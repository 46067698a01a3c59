"""NVIDIA Warp kernels, installed as ``voronerf.kernels``: one file per op, one source for CPU and CUDA.

On the CPU Warp runs on one thread, so there it is a path for checking. Importing this package raises
``BackendUnavailable`` where Warp is missing or too old; ``import voronerf`` never imports it.
"""

from __future__ import annotations

from typing import Any

import torch

from voronerf.backends import BackendUnavailable

MINIMUM = (1, 10)
_REMEDY = "install it with `pip install 'voronerf[warp]'` (warp-lang >= 1.10)"

try:
    import warp as wp
except ImportError as error:
    raise BackendUnavailable(f"NVIDIA Warp is not installed; {_REMEDY}") from error

_VERSION: str = getattr(wp, "__version__", None) or wp.config.version
if tuple(int(part) for part in _VERSION.split(".")[:2]) < MINIMUM:
    raise BackendUnavailable(f"NVIDIA Warp {_VERSION} is too old; {_REMEDY}")

# The banner and the notes on compilation, silenced unless someone has asked for more. Older releases say `quiet`.
if not hasattr(wp.config, "log_level"):
    wp.config.quiet = True
elif wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING
wp.init()


def missing(device: torch.device) -> str | None:
    """Reason, with the remedy, why Warp cannot run on a device; None if it can."""
    if device.type == "cuda" and not wp.is_cuda_available():
        return "this build of NVIDIA Warp sees no CUDA driver; install warp-lang from PyPI and check the driver"
    return None


def describe() -> dict[str, Any]:
    """Version and devices."""
    return {"version": _VERSION, "devices": [str(device) for device in wp.get_devices()]}
