"""``resample`` of the compiled module. r rays, s bins of a ray. The arithmetic is float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared


def _on_cuda(arguments: Any, depths: Tensor, machine: native.compiled.Cuda) -> None:
    sums = depths.new_empty(arguments.r, arguments.s, dtype=torch.float64)
    tensors = arguments.weights, arguments.edges, arguments.uniforms, depths, sums
    native.compiled.resample(*tensors, arguments.r, arguments.s, arguments.count, machine)


resample = in_float32(
    declared("resample").compiled_op(
        "resample_native", "resample", *("weights", "edges", "uniforms", "result", "r", "s", "count"), on_cuda=_on_cuda
    )
)
