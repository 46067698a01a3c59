"""Words of messages: lists, and what was meant where a word is unknown."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

#: Names that other programs have for settings.
SAID_ELSEWHERE = {
    **dict.fromkeys(("epochs", "iterations", "max-num-iterations"), "steps"),
    **dict.fromkeys(("input", "source-path"), "data"),
    "batch-size": "rays",
    "cuda": "device",
    "gpu": "device",
    "model-path": "out",
}


def either(names: Sequence[str]) -> str:
    """``a, b or c``."""
    return " or ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else names[0]


def as_typed(value: object) -> str:
    """A value as a person types it: ``2 0.5`` for the numbers (2.0, 0.5), other words in quotes."""
    if isinstance(value, tuple | list):
        return " ".join(map(as_typed, value)) or "none"
    return f"{value:.15g}" if isinstance(value, float) else repr(value)


def did_you_mean(word: object, words: Iterable[str]) -> str:
    """``; did you mean nerf?`` for the most similar of some words; empty if none is similar."""
    near = nearest(str(word), words)
    return f"; did you mean {near}?" if near else ""


def nearest(word: str, words: Iterable[str]) -> str | None:
    """The most similar of some words, or the one that other programs call so; None if none is similar."""
    by_lower = {one.lower(): one for one in words}
    word = word.lower()
    elsewhere = SAID_ELSEWHERE.get(word.replace("_", "-"))
    near = [elsewhere] if elsewhere in by_lower else difflib.get_close_matches(word, by_lower, 1)
    return by_lower[near[0]] if near else None


def similar_path(path: Path, others: Iterable[Path]) -> str:
    """``; did you mean scenes/fox?`` for the path whose name is the most similar; empty if none is."""
    by_name = {other.name: other for other in others}
    near = nearest(path.name, by_name)
    return f"; did you mean {by_name[near]}?" if near else ""


def device_of(word: str) -> str | None:
    """The device that a word such as gpu, CUDA, gpu:1 or 1 stands for; None for other words."""
    match = re.fullmatch(r"(cpu)|(?:cuda|gpu):?(\d*)|(\d+)", word.lower())
    if not match:
        return None
    number = match[2] or match[3]
    return match[1] or (f"cuda:{number}" if number else "cuda")
