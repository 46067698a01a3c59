"""Wording of messages: lists, and suggestions for unknown words."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

#: Names of settings and formats in other programs, each with its name in voronerf.
SAID_ELSEWHERE = {
    **dict.fromkeys(("epochs", "iterations", "max-num-iterations"), "steps"),
    **dict.fromkeys(("input", "source-path"), "data"),
    "batch-size": "rays",
    **dict.fromkeys(("cpu", "cuda", "gpu"), "device"),
    "model-path": "out",
    **dict.fromkeys(("nerfstudio", "instant-ngp", "ngp", "polycam", "record3d"), "transforms"),
    **dict.fromkeys(("nerf-synthetic", "synthetic", "nerf", "blendernerf", "dnerf", "d-nerf"), "blender"),
    **dict.fromkeys(("mipnerf360", "gaussian-splatting", "3dgs"), "colmap"),
    "nerf-llff": "llff",
}

#: Units of time in seconds.
TIMES = {"d(?:ays?)?": 86400, "h(?:(?:ou)?rs?)?": 3600, "m(?:in(?:ute)?s?)?": 60, "s(?:ec(?:ond)?s?)?": 1}
#: Dashes other than the hyphen, which text processors and web pages write for it.
DASHES = "\u2010\u2011\u2012\u2013\u2014\u2015\u2212\ufe58\ufe63\uff0d"


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
    synonym = SAID_ELSEWHERE.get(word.replace("_", "-").removesuffix("-data"))
    matches = [synonym] if synonym in by_lower else difflib.get_close_matches(word, by_lower, 1)
    return by_lower[matches[0]] if matches else None


def meant_number(text: str, *, whole: bool, seconds: bool = False) -> str | None:
    """Returns the number that people mean by a text such as 1,000, 1.5k, 0,02 or, in seconds, 10min; None if unclear.

    Args:
        text: The text, in lower case.
        whole: Whether the number must be whole.
        seconds: Whether the number is a time in seconds.
    """
    if (whole or seconds) and re.fullmatch(r"[1-9]\d{0,2}([,' ]\d{3})+", text):
        return re.sub("[,' ]", "", text)
    plain = text if whole else re.sub(r"^(-?\d+),(\d{1,2}|\d{4,})$", r"\1.\2", text)  # the comma of other languages
    number, value = r"\d+(?:\.\d+)?", None
    if seconds and re.fullmatch(r"\d+(:\d\d){1,2}", plain):
        value = sum(60.0**place * int(part) for place, part in enumerate(reversed(plain.split(":"))))
    elif seconds and plain and re.fullmatch("".join(rf"(?:{number} *{unit} *)?" for unit in TIMES), plain):
        pairs = ((re.search(rf"({number}) *{unit}(?![a-z])", plain), size) for unit, size in TIMES.items())
        value = sum(size * float(match[1]) for match, size in pairs if match)
    elif match := re.fullmatch(rf"(-?(?:{number}|\.\d+)(?:e[+-]?\d{{1,2}})?) *(k?)", plain):
        value = float(match[1]) * (1000 if match[2] else 1)
    if value is None or abs(value) >= 1e15 or (whole and (value % 1 or ("." in plain and not plain.endswith("k")))):
        return None
    return f"{value:.15g}"


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
