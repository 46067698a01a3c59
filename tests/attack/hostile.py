"""Hostile values, and hostile changes of JSON and bytes."""

from __future__ import annotations

import copy
import json
import random
from typing import Any

NUMBERS = (
    *(0, -1, 1, 2, 1e308, -1e308, 1e-300, 1e38, float("nan"), float("inf")),
    *(2**31 - 1, 2**31, 2**63, 10**30, 10**400, -0.0, 0.5),
)
TEXTS = (
    *("", "x", "\x1b]0;owned\x07", "../../outside", "/etc/passwd", "a\0b", "é" * 3000, "\u202e"),
    *("-1", "None", "builtin"),
)
VALUES = (*NUMBERS, *TEXTS, None, True, False, [], {}, [[]], [1, "a", None], {"a": {"b": 1}}, [0] * 3000)


def nested(depth: int) -> Any:
    """Returns nested lists of a given depth."""
    value: Any = 0
    for _ in range(depth):
        value = [value]
    return value


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Returns the paths of all values in nested lists and dictionaries."""
    paths = [path] if path else []
    if isinstance(value, (dict, list)):
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        for key, entry in entries:
            paths += places(entry, (*path, key))
    return paths


def mutated(rng: random.Random, value: Any) -> Any:
    """Copies a JSON value and replaces, removes, doubles or scales one value in it."""
    value = copy.deepcopy(value)
    *to, last = rng.choice(places(value))
    holder = value
    for key in to:
        holder = holder[key]
    there, kind = holder[last], rng.randrange(8)
    if kind == 0:
        del holder[last]
    elif kind == 1 and isinstance(there, list):
        holder[last] = there * 2
    elif kind <= 3 and isinstance(there, (int, float)) and not isinstance(there, bool):
        holder[last] = there * rng.choice((-1, 1e6, 1e-6, 1e20)) + rng.choice((0, 1))
    elif kind == 4 and isinstance(holder, dict):
        holder[rng.choice(TEXTS)] = there
    elif kind == 5:
        holder[last] = nested(rng.choice((2, 90, 5000)))
    else:
        holder[last] = rng.choice(VALUES)
    return value


def json_text(value: Any) -> bytes:
    """Returns a value as JSON; values nested too deeply for Python's writer become plain brackets."""
    try:
        return json.dumps(value).encode()
    except RecursionError:
        return b"[" * 100_000


def damaged(rng: random.Random, data: bytes) -> bytes:
    """Returns damaged bytes: one bit flipped, some bytes overwritten or inserted, or the end cut off."""
    kind, at = rng.randrange(6), rng.randrange(max(1, len(data)))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes(rng.randrange(1, 64)) + data[at:]
    if kind == 2:
        length = min(rng.randrange(1, 512), len(data) - at)
        return data[:at] + rng.randbytes(length) + data[at + length :]
    return flipped(data, 8 * at + rng.randrange(8))


def flipped(data: bytes, bit: int) -> bytes:
    """Returns the bytes with one bit flipped."""
    return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]
