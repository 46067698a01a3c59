"""``resample`` of the compiled module. r rays, s bins of a ray. The arithmetic is float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared


def _on_cuda(given: Any, depths: Tensor, machine: native.compiled.Cuda) -> None:
    sums = depths.new_empty(given.r, given.s, dtype=torch.float64)
    tensors = given.weights, given.edges, given.uniforms, depths, sums
    native.compiled.resample(*tensors, given.r, given.s, given.count, machine)


resample = in_float32(
    declared("resample").compiled_op(
        "resample_native", "resample", *("weights", "edges", "uniforms", "result", "r", "s", "count"), on_cuda=_on_cuda
    )
)
