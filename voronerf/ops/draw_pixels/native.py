"""``draw_pixels`` of the compiled module."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("draw_pixels")


def _of(part: str, name: str) -> Any:
    """Returns a function that reads an attribute of the argument ``part``; it returns None if the argument is None."""
    return lambda arguments: getattr(getattr(arguments, part), name, None)


_inputs = _OP.inputs(
    native.compiled.DrawPixelsInputs,
    ends=_of("runs", "ends"),
    shift=_of("runs", "shift"),
    first=_of("runs", "first"),
    n=lambda arguments: 0 if arguments.runs is None else len(arguments.runs.ends),
    places=lambda arguments: 0 if arguments.runs is None else len(arguments.runs.first),
    bits=lambda arguments: 0 if arguments.runs is None else arguments.runs.bits,
    b="count",
    known_pixels=_of("known_pixels", "pixels"),
    distances=_of("known_pixels", "distances"),
    known_count="draws",
    p=lambda arguments: 0 if arguments.known_pixels is None else len(arguments.known_pixels.pixels),
)
draw_pixels = _OP.compiled_op("draw_pixels_native", "draw_pixels", _inputs, "result0", "result1", "result2")
