"""``draw_pixels`` of the compiled module."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("draw_pixels")


def _of(part: str, name: str) -> Any:
    """A member of the runs or the known pixels; None where there are none."""
    return lambda given: getattr(getattr(given, part), name, None)


_inputs = _OP.inputs(
    native.compiled.DrawPixelsInputs,
    ends=_of("runs", "ends"),
    shift=_of("runs", "shift"),
    first=_of("runs", "first"),
    n=lambda given: 0 if given.runs is None else len(given.runs.ends),
    places=lambda given: 0 if given.runs is None else len(given.runs.first),
    bits=lambda given: 0 if given.runs is None else given.runs.bits,
    b="count",
    known=_of("known", "pixels"),
    distances=_of("known", "distances"),
    p=lambda given: 0 if given.known is None else len(given.known.pixels),
)
draw_pixels = _OP.compiled_op("draw_pixels_native", "draw_pixels", _inputs, "result0", "result1", "result2")
