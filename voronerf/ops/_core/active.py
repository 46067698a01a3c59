"""What the calling thread records, for those who take part in it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from torch import Tensor


class _Active(threading.local):
    recording: Any = None
    vary: Callable[[Callable[[], float]], Tensor] | None = None


active = _Active()
"""The :class:`voronerf.ops._core.recording.Recording`, and what makes numbers for replays, those of a GPU too."""
