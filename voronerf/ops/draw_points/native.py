"""``draw_points`` of the compiled module."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared


@declared("draw_points").custom_op("draw_points_native")
def draw_points(given: Any, found: Tensor) -> None:
    """Points in a box; see ``voronerf.ops.draw_points``."""
    native.compiled.draw_points(given.seed, given.box, given.count, found, native.machine(given.seed))
