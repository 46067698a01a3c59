"""``grouped_linear`` of the compiled module: on CUDA a network of one layer, on the CPU kernels of its own.

float32 and bfloat16 are read and written as they are stored; float16 and float64 are cast to float32 on the way in and
back on the way out.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.grouped_linear.cpu import layer
from voronerf.ops.grouped_mlp import native as grouped_mlp

_STORED = (torch.float32, torch.bfloat16)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``."""
    if native.on_cuda(x):
        return grouped_mlp.grouped_linear(x, offsets, weight, bias, activation)
    dtype = x.dtype
    if torch.is_autocast_enabled(x.device.type) and dtype != torch.float64:
        dtype = torch.get_autocast_dtype(x.device.type)
    stored = dtype if dtype in _STORED else torch.float32
    given = (x.to(stored), offsets, weight.to(stored), None if bias is None else bias.to(stored))
    out: Tensor = layer(*given, activation)
    return out.to(dtype)
