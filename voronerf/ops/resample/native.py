"""``resample`` of the compiled module. r rays, s bins of a ray. The arithmetic is float32."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op, in_float32


@custom_op("resample_native")
def _resample(weights: Tensor, edges: Tensor, count: int, uniforms: Tensor | None) -> Iterator[Tensor]:
    r, s = weights.shape
    depths = edges.new_empty(r, count)
    yield depths
    compiled, machine = native.compiled, native.machine(weights)
    if isinstance(machine, compiled.Cuda):
        workspace = weights.new_empty(r, s, dtype=torch.float64)
        compiled.resample(weights, edges, uniforms, depths, workspace, r, s, count, machine)
    else:
        compiled.resample(weights, edges, uniforms, depths, r, s, count, machine)


def resample(weights: Tensor, edges: Tensor, count: int, uniforms: Tensor | None) -> Tensor:
    """Depths drawn in proportion to the weights of the bins; see ``voronerf.ops.resample``."""
    depths: Tensor = in_float32(_resample, (weights, edges, count, uniforms))
    return depths
