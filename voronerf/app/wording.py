"""Wording of messages: lists, and suggestions for unknown words."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

#: Names of settings in other programs, each with its name in voronerf.
SAID_ELSEWHERE = {
    **dict.fromkeys(("epochs", "iterations", "max-num-iterations"), "steps"),
    **dict.fromkeys(("input", "source-path"), "data"),
    "batch-size": "rays",
    "cuda": "device",
    "gpu": "device",
    "model-path": "out",
}


def either(names: Sequence[str]) -> str:
    """Returns names as ``a, b or c``."""
    return " or ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else names[0]


def as_typed(value: object) -> str:
    """Returns a value as typed on a command line: ``2 0.5`` for (2.0, 0.5), text in quotes."""
    if isinstance(value, tuple | list):
        return " ".join(map(as_typed, value)) or "none"
    return f"{value:.15g}" if isinstance(value, float) else repr(value)


def did_you_mean(word: object, words: Iterable[str]) -> str:
    """Returns ``; did you mean nerf?`` for the most similar of ``words``; empty if none is similar."""
    similar = nearest(str(word), words)
    return f"; did you mean {similar}?" if similar else ""


def nearest(word: str, words: Iterable[str]) -> str | None:
    """Returns the setting that other programs call ``word``, or the most similar of ``words``, or None."""
    by_lower = {candidate.lower(): candidate for candidate in words}
    word = word.lower()
    synonym = SAID_ELSEWHERE.get(word.replace("_", "-"))
    matches = [synonym] if synonym in by_lower else difflib.get_close_matches(word, by_lower, 1)
    return by_lower[matches[0]] if matches else None


def similar_path(path: Path, others: Iterable[Path]) -> str:
    """Returns ``; did you mean scenes/fox?`` for the path with the most similar name; empty if none is similar."""
    by_name = {other.name: other for other in others}
    name = nearest(path.name, by_name)
    return f"; did you mean {by_name[name]}?" if name else ""


def device_of(word: str) -> str | None:
    """Returns the device for a word such as gpu, CUDA, gpu:1 or 1; None for other words."""
    match = re.fullmatch(r"(cpu)|(?:cuda|gpu):?(\d*)|(\d+)", word.lower())
    if not match:
        return None
    number = match[2] or match[3]
    return match[1] or (f"cuda:{number}" if number else "cuda")
