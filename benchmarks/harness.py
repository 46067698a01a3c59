"""What the benchmarks share: the metadata of a result, so that every file under results/ says where it was measured."""

from __future__ import annotations

import platform
import re
from pathlib import Path
from typing import Any

import torch

from voronerf import __version__, backends


def processor() -> str:
    """The processor's name."""
    path = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", path.read_text()) if path.is_file() else []
    return names[0] if names else platform.processor() or platform.machine()


def metadata(**extra: Any) -> dict[str, Any]:
    """A benchmark's own entries, followed by the versions and the machine; ready for JSON."""
    return {
        **extra,
        "voronerf": __version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
        "machine": processor(),
        "native": backends.describe()["native"],
    }
