"""``grouped_linear`` of the compiled module: a program of one layer.

float32 and, on the CPU, bfloat16 tensors are read and written without casts. Tensors of other dtypes are cast to
float32, and the results are cast back.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core.layers import ACTIVATIONS, MLP, POSITIONS, Layer, program_text
from voronerf.ops.network.native import PRODUCTS, Run

# The text of a one-layer table for each activation. The width of the weight replaces the width 1.
_TABLES = {activation: MLP((Layer((POSITIONS,), 1, activation),), (0,)).text for activation in ACTIVATIONS}


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Applies the layer of each sample's cell; see ``voronerf.ops.grouped_linear``."""
    dtype = x.dtype
    if torch.is_autocast_enabled(x.device.type) and dtype != torch.float64:
        dtype = torch.get_autocast_dtype(x.device.type)
    stored = dtype if dtype == torch.bfloat16 else torch.float32
    rounded = [p.to(dtype).float() for p in (weight, bias) if p is not None]
    o, i = len(range(weight.shape[1])), len(range(weight.shape[2]))  # plain ints, not symbolic ones
    shape = i, 0, (o,), (bias is not None,), False
    text, products = program_text(_TABLES[activation], *shape), PRODUCTS.get(dtype, "float32")
    layer = Run([x.to(dtype).to(stored)], rounded, offsets, None, None, (), text, "grouped_linear", products=products)
    (out,) = layer.results()
    return out.to(dtype)
