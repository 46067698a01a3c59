"""``sparse_depth_gradient`` of the compiled module, on the CPU."""

from __future__ import annotations

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import Memory, declared
from voronerf.ops.sparse_depth_gradient.reference import NEARBY

_OP = declared("sparse_depth_gradient")
_inputs = _OP.inputs(native.compiled.SparseDepth, offsets="ray_offsets", nearby=NEARBY)
sparse_depth_gradient = _OP.compiled_op(
    "sparse_depth_gradient_native",
    "sparse_depth_gradient",
    *(_inputs, "loss", "gradient", Memory(torch.float32, "s")),
    devices=("cpu",),
)
