"""``unseen_rays`` of the compiled module, on the CPU."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("unseen_rays")
_inputs = _OP.inputs(native.compiled.UnseenRays)


@_OP.custom_op("unseen_rays_native", devices=("cpu",))
def unseen_rays(given: Any, _: None) -> None:
    """Moves the last rays; see ``voronerf.ops.unseen_rays``."""
    native.compiled.unseen_rays(_inputs(given), given.origins, given.directions, native.cpu())
