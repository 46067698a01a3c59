"""``grouped_linear`` of the compiled module: a program of one layer.

float32 and, on the CPU, bfloat16 are read and written as they are stored; other types are cast to float32 on the way in
and back on the way out.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from voronerf.ops._core.layers import MLP, POSITIONS, Layer
from voronerf.ops._core.program import Program
from voronerf.ops.grouped_program.native import How, Rows, run_program

_PRODUCTS = {torch.bfloat16: "bfloat16", torch.float16: "float16"}


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``."""
    dtype = x.dtype
    if torch.is_autocast_enabled(x.device.type) and dtype != torch.float64:
        dtype = torch.get_autocast_dtype(x.device.type)
    stored = dtype if dtype == torch.bfloat16 else torch.float32
    rounded = [p.to(dtype).float() for p in (weight, bias) if p is not None]
    program = _program(int(weight.shape[2]), int(weight.shape[1]), bias is not None, activation)
    rows = Rows([x.to(dtype).to(stored)], rounded, offsets, None, None, [])
    (out,) = run_program(rows, How(program.text, "grouped_linear", _PRODUCTS.get(dtype, "float32")), program)
    return out.to(dtype)


@functools.lru_cache(maxsize=256)
def _program(i: int, o: int, biased: bool, activation: str) -> Program:
    return MLP((Layer((POSITIONS,), o, activation),), (0,)).program(i, 0, (o,), (biased,), False)
