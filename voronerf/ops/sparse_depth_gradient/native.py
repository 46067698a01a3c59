"""``sparse_depth_gradient`` of the compiled module, on the CPU: no custom op, as a step calls it for its gradient."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops.sparse_depth_gradient.reference import NEARBY

_OP = declared("sparse_depth_gradient")
_inputs = _OP.inputs(native.compiled.SparseDepth, offsets="ray_offsets", nearby=str(NEARBY))


@_OP.plain
def sparse_depth_gradient(given: Any, found: tuple[Tensor, Tensor]) -> None:
    """The loss [] and its gradient [m]; see ``voronerf.ops.sparse_depth_gradient``."""
    loss, gradient = found
    of_rays = loss.new_empty(given.s)
    native.compiled.sparse_depth_gradient(_inputs(given), loss, of_rays, gradient, native.cpu())
