"""``rendered_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("rendered_gradient")
_inputs = _OP.inputs(native.compiled.RenderedGradient, offsets="ray_offsets")


@_OP.custom_op("rendered_gradient_native", devices=("cpu",))
def rendered_gradient(given: Any, _: None) -> None:
    """Adds the gradient; see ``voronerf.ops.rendered_gradient``."""
    native.compiled.rendered_gradient(_inputs(given), given.gradient, native.cpu())
