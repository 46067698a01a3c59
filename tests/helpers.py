"""What tests of every room share: refusals, seeded generators, equal tensors, scripts, files of JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch


def refuses(message: str, call: Callable[..., Any], *args: Any, error: type[Exception] = ValueError, **options: Any):
    """Fails unless the call raises an error of one line that contains ``message``, which is no pattern."""
    with pytest.raises(error) as caught:
        call(*args, **options)
    text = str(caught.value)
    assert message in text and "\n" not in text, text


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def same(first: Any, second: Any) -> bool:
    """Whether two sequences of tensors, or two dictionaries of them, are equal bit for bit."""
    if isinstance(first, Mapping):
        return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def python(*args: Any, **options: Any) -> str:
    """The output of a Python process, which must succeed."""
    command = [sys.executable, *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())
