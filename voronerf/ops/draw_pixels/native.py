"""``draw_pixels`` of the compiled module."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared


@declared("draw_pixels").custom_op("draw_pixels_native")
def draw_pixels(given: Any, found: tuple[Tensor, Tensor, Tensor]) -> None:
    """Pixels, and three uniform numbers for each; see ``voronerf.ops.draw_pixels.reference``."""
    seed, count, below, runs, known = given
    ends, shift, first, bits, _ = runs or (None, None, None, 0, below)
    n, places = (0, 0) if ends is None or first is None else (len(ends), len(first))
    of_runs = seed, ends, shift, first, n, places, bits, below, count
    pixels, distances, several = known or (None, None, 0)
    p = 0 if pixels is None else len(pixels)
    inputs = native.compiled.DrawPixelsInputs(*of_runs, pixels, distances, p, several)
    native.compiled.draw_pixels(inputs, *found, native.machine(seed))
