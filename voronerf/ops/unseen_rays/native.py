"""``unseen_rays`` of the compiled module, on the CPU."""

from __future__ import annotations

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("unseen_rays")
_inputs = _OP.inputs(native.compiled.UnseenRays)
unseen_rays = _OP.compiled_op("unseen_rays_native", "unseen_rays", _inputs, "origins", "directions", devices=("cpu",))
