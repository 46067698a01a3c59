"""``scale_gradient`` of the compiled module."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared


@declared("scale_gradient").custom_op("scale_gradient_native")
def scale_gradient(given: Any, _: None) -> None:
    """Multiplies the gradients of samples by their shares; see ``voronerf.ops.scale_gradient``."""
    gradient, depths, full = given
    native.compiled.scale_gradient(depths, full, given.m, given.c, gradient, native.machine(gradient))
