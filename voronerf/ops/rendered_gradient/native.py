"""``rendered_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("rendered_gradient")
_inputs = _OP.inputs(native.compiled.RenderedGradient, offsets="ray_offsets")
rendered_gradient = _OP.compiled_op(
    "rendered_gradient_native", "rendered_gradient", _inputs, "gradient", devices=("cpu",)
)
