"""``resample`` of the compiled module. r rays, s bins of a ray. The arithmetic is float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared


@declared("resample").custom_op("resample_native")
def _resample(given: Any, depths: Tensor) -> None:
    compiled, machine = native.compiled, native.machine(depths)
    tensors, sizes = (given.weights, given.edges, given.uniforms, depths), (given.r, given.s, given.count)
    if isinstance(machine, compiled.Cuda):
        compiled.resample(*tensors, depths.new_empty(given.r, given.s, dtype=torch.float64), *sizes, machine)
    else:
        compiled.resample(*tensors, *sizes, machine)


resample = in_float32(_resample)
