"""Type checks of JSON values, by the annotations of a dataclass."""

from __future__ import annotations

import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from voronerf.app.wording import did_you_mean, nearest


def check_types(source: str, kind: type, values: object, *, optional: bool = False) -> None:
    """Checks that values fit the fields of a dataclass.

    Args:
        source: The file, and the place in it, for errors.
        kind: The dataclass.
        values: The values by name, with tuples in place of JSON lists.
        optional: Whether fields may be missing.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{source}: must be an object, got {_short(values)}")
    hints = get_type_hints(kind)
    if unknown := sorted(values.keys() - hints.keys()):
        similar = ", ".join(filter(None, (nearest(str(name), hints) for name in unknown)))
        raise ValueError(f"{source}: unknown {', '.join(unknown)}" + (f"; did you mean {similar}?" if similar else ""))
    if not optional and (missing := sorted(hints.keys() - values.keys())):
        raise ValueError(f"{source}: {', '.join(missing)} missing")
    for name, value in values.items():
        if not _fits(value, hints[name]):
            choices = get_args(hints[name]) if get_origin(hints[name]) is Literal else ()
            hint = did_you_mean(value, choices)
            raise ValueError(f"{source}: {name} must be {_named(hints[name])}, got {_short(value)}{hint}")


def _fits(value: object, hint: Any) -> bool:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, alternative) for alternative in inner)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(entry, inner[0]) for entry in value)
    if isinstance(value, bool):  # bool is a subclass of int
        return hint is bool
    return isinstance(value, (int, float)) if hint is float else isinstance(value, origin or hint)


def _named(hint: Any) -> str:
    """Describes a type in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_named(alternative) for alternative in inner)
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        return f"a list, each entry {_named(inner[0])}"
    words = {int: "an integer", float: "a number", bool: "true or false", str: "text", Path: "text", type(None): "null"}
    return words.get(origin or hint, "an object")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:60]}..."
