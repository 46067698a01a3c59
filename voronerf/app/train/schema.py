"""The types of values that were read from JSON, by the annotations of the dataclass that they are for."""

from __future__ import annotations

import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from voronerf.app.wording import did_you_mean, nearest


def check_types(source: str, kind: type, values: object, *, optional: bool = False) -> None:
    """Checks that values fit the fields of a dataclass.

    Args:
        source: The file, and the place in it, that an error names.
        kind: The dataclass.
        values: By name, with tuples for the lists of JSON.
        optional: Fields may be missing.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{source}: must be an object, got {_short(values)}")
    hints = get_type_hints(kind)
    if unknown := sorted(values.keys() - hints.keys()):
        near = ", ".join(filter(None, (nearest(str(name), hints) for name in unknown)))
        raise ValueError(f"{source}: unknown {', '.join(unknown)}" + (f"; did you mean {near}?" if near else ""))
    if not optional and (missing := sorted(hints.keys() - values.keys())):
        raise ValueError(f"{source}: {', '.join(missing)} missing")
    for name, value in values.items():
        if not _fits(value, hints[name]):
            words = get_args(hints[name]) if get_origin(hints[name]) is Literal else ()
            end = did_you_mean(value, words)
            raise ValueError(f"{source}: {name} must be {_named(hints[name])}, got {_short(value)}{end}")


def _fits(value: object, hint: Any) -> bool:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(entry, inner[0]) for entry in value)
    if isinstance(value, bool):  # which is an int to Python
        return hint is bool
    return isinstance(value, (int, float)) if hint is float else isinstance(value, origin or hint)


def _named(hint: Any) -> str:
    """A type in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_named(one) for one in inner)
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        return f"a list, each entry {_named(inner[0])}"
    words = {int: "an integer", float: "a number", bool: "true or false", str: "text", Path: "text", type(None): "null"}
    return words.get(origin or hint, "an object")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:60]}..."
