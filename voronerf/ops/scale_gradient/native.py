"""``scale_gradient`` of the compiled module: no custom op, as it works in place on what no graph holds."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared


@declared("scale_gradient").plain
def scale_gradient(given: Any) -> None:
    """Multiplies the gradients of samples by their shares; see ``voronerf.ops.scale_gradient``."""
    gradient, depths, full = given
    native.compiled.scale_gradient(depths, full, given.m, given.c, gradient, native.machine(gradient))
