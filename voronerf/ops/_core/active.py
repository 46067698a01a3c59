"""The active recording of the calling thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class _Active(threading.local):
    recording: Any = None
    vary: Callable[[Callable[[], float]], Tensor] | None = None


active = _Active()
"""The active :class:`voronerf.ops._core.recording.Recording` or None, and the function with which a recording (CPU) or
capture (GPU) makes a number that varies between replays."""


def is_recorded() -> bool:
    """Returns whether the calling thread's work is recorded or captured, also by :class:`torch.cuda.graph`.

    Then the host must not read values from the device.
    """
    return active.vary is not None or (torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing())
