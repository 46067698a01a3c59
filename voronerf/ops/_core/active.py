"""The active recording of the calling thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from torch import Tensor


class _Active(threading.local):
    recording: Any = None
    vary: Callable[[Callable[[], float]], Tensor] | None = None


active = _Active()
"""The active :class:`voronerf.ops._core.recording.Recording` or None, and the function with which a recording (CPU) or
capture (GPU) makes a number that varies between replays."""
