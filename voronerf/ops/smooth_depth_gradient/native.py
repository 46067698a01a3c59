"""``smooth_depth_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import Memory, declared
from voronerf.ops.smooth_depth_gradient.reference import EDGE

_OP = declared("smooth_depth_gradient")
_inputs = _OP.inputs(native.compiled.SmoothDepth, offsets="ray_offsets", edge=EDGE)
smooth_depth_gradient = _OP.compiled_op(
    "smooth_depth_gradient_native",
    "smooth_depth_gradient",
    *(_inputs, "loss", "gradient", Memory(torch.float32, "r")),
    devices=("cpu",),
)
