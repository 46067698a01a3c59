"""``grouped_linear`` of the compiled module: a program of one layer.

float32 and, on the CPU, bfloat16 tensors are read and written without casts. Tensors of other dtypes are cast to
float32, and the results are cast back.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core.checks import dtype_under_autocast
from voronerf.ops.grouped_linear.activation import one_layer
from voronerf.ops.network.native import PRODUCTS, Run


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Applies the layer of each sample's cell; see ``voronerf.ops.grouped_linear``."""
    dtype = dtype_under_autocast(x.dtype, x)
    stored = dtype if dtype == torch.bfloat16 else torch.float32
    rounded = [p.to(dtype).float() for p in (weight, bias) if p is not None]
    text, products = one_layer(weight, bias, activation).text, PRODUCTS.get(dtype, "float32")
    layer = Run([x.to(dtype).to(stored)], rounded, offsets, None, None, (), text, "grouped_linear", products=products)
    (out,) = layer.results()
    return out.to(dtype)
