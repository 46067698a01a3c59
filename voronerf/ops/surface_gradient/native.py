"""``surface_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import Memory, declared

_OP = declared("surface_gradient")
_inputs = _OP.inputs(native.compiled.Surface, offsets="ray_offsets")
surface_gradient = _OP.compiled_op(
    "surface_gradient_native",
    "surface_gradient",
    *(_inputs, "loss", "gradient", Memory(torch.float32, "r")),
    devices=("cpu",),
)
