"""``smooth_depth_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty
from voronerf.ops.smooth_depth_gradient.reference import EDGE

_OP = declared("smooth_depth_gradient")
_inputs = _OP.inputs(native.compiled.SmoothDepth, offsets="ray_offsets", edge=EDGE)


@_OP.custom_op("smooth_depth_gradient_native", devices=("cpu",))
def smooth_depth_gradient(given: Any, _: None) -> None:
    """Adds the loss of bent depths; see ``voronerf.ops.smooth_depth_gradient``."""
    of_rays = new_empty(given.far, given.r)
    native.compiled.smooth_depth_gradient(_inputs(given), given.loss, given.gradient, of_rays, native.cpu())
