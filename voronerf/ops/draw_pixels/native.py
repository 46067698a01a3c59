"""``draw_pixels`` of the compiled module."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("draw_pixels")


def _of_runs(name: str) -> Any:
    return lambda given: None if given.runs is None else getattr(given.runs, name)


def _of_known(name: str) -> Any:
    return lambda given: None if given.known is None else getattr(given.known, name)


_inputs = _OP.inputs(
    native.compiled.DrawPixelsInputs,
    ends=_of_runs("ends"),
    shift=_of_runs("shift"),
    first=_of_runs("first"),
    n=lambda given: 0 if given.runs is None else len(given.runs.ends),
    places=lambda given: 0 if given.runs is None else len(given.runs.first),
    bits=lambda given: 0 if given.runs is None else given.runs.bits,
    b="count",
    known=_of_known("pixels"),
    distances=_of_known("distances"),
    p=lambda given: 0 if given.known is None else len(given.known.pixels),
)
draw_pixels = _OP.compiled_op("draw_pixels_native", "draw_pixels", _inputs, "result0", "result1", "result2")
