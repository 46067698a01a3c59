"""``sparse_depth_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty
from voronerf.ops.sparse_depth_gradient.reference import NEARBY

_OP = declared("sparse_depth_gradient")
_inputs = _OP.inputs(native.compiled.SparseDepth, offsets="ray_offsets", nearby=NEARBY)


@_OP.custom_op("sparse_depth_gradient_native", devices=("cpu",))
def sparse_depth_gradient(given: Any, _: None) -> None:
    """Adds the loss and its gradient; see ``voronerf.ops.sparse_depth_gradient``."""
    loss, gradient, of_rays = given.loss, given.gradient, new_empty(given.density, given.s)
    native.compiled.sparse_depth_gradient(_inputs(given), loss, gradient, of_rays, native.cpu())
